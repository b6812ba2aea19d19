// Runs the sketch by a script: see Arduino.h here.
#include "Arduino.h"
#include "../../../../config/firmware/teensy/teensy.ino"

using namespace sim;

static void pass(uint64_t until) {  // the interrupts up to a time; one that is due while another is served comes late
  for (;;) {
    size_t next_edge = 0;
    static uint64_t served = 0;
    while (next_edge < edges.size() && edges[next_edge].first <= served) next_edge++;
    uint64_t edge_at = next_edge < edges.size() ? edges[next_edge].first : NEVER, due = min(edge_at, timer_at);
    if (due > until) break;
    at = std::max(at, due) + ENTRY;
    if (edge_at <= timer_at) {
      served = edge_at;
      while (edges.size() > 1 && edges[1].first <= served) edges.pop_front();
      edge_call();
    } else {
      timer_at = NEVER;
      timer_call();
    }
  }
  at = std::max(at, until);
}

int main() {
  struct Event { uint64_t when; std::string what, value; };
  std::vector<Event> events;
  for (Event e; std::cin >> e.when >> e.what && (e.what == "end" || std::cin >> e.value);) events.push_back(e);
  for (auto &e : events) if (e.what == "marker") edges.push_back({e.when, e.value == "1"});
  setup();
  for (auto &e : events) {
    pass(e.when);
    if (e.what == "dtr") Serial.dtr_level = e.value == "1";
    if (e.what == "suspend") USB1_PORTSC1 = e.value == "1" ? USB_PORTSC1_SUSP : 0;
    for (size_t i = 0; e.what == "send" && i + 1 < e.value.size(); i += 2) received += char(std::stoi(e.value.substr(i, 2), nullptr, 16));
    loop();
  }
}
