// Sync source on a Teensy 4.0 or 4.1: plays words of three output levels, triggered by a scan marker. Wiring, protocol
// and times: docs/reference/teensy.md of spadrig. Board Teensy 4.0 or 4.1, USB type Serial, CPU speed 600 MHz.
#include <stdarg.h>

static_assert(F_CPU == 600000000, "set Tools > CPU Speed to 600 MHz: words are timed by its cycles");
// Outputs 1 (frame), 2 (gate) and 4 (marker) are pins 2, 3 and 4: bits 4, 5 and 6 of port GPIO9, so that one store
// changes them together.
const int FIRST_PIN = 2, N_PINS = 3, PORT_BIT = 4, SCAN_PIN = 5;
const uint8_t GATE = 2, HELD = 8, HELD_GATE = HELD | GATE;
const uint32_t MAX_WORDS = 30000, SHORTEST = 500, MAX_WATCHDOG_MS = 60000, LONGEST_LINE = 1023;
const uint32_t TICK = F_CPU / 100000000, US = F_CPU / 1000000, MS = F_CPU / 1000;  // cycles
const uint32_t EARLY = 1 * US, NEAR = 2 * US;  // the timer comes 1 us early, and is not set for less than 2 us

enum State { STOPPED, PLAYING, ABORTED };
enum Load { EMPTY, LOADING, LOADED };
struct Word { uint32_t ticks; uint8_t bits; };  // ticks of 10 ns, 0: wait for the scan marker; bits: outputs | HELD

Load load = EMPTY;
Word words[MAX_WORDS];
uint32_t n_words, repeats, crc, length;
char line[LONGEST_LINE + 1], tag[11];
bool too_long;

// The player's own. The main program touches these only while interrupts are blocked.
IntervalTimer timer;
volatile State state = STOPPED;
const char *why = "none";
uint32_t place, rounds, sweeps, cuts;
uint64_t cycles, word_start, low_since, hold, beat, watchdog;
bool marker_low, cut, gate_low;

uint64_t now() {  // the cycle counter, which wraps after 7 s, in 64 bits: it is read every millisecond during a program
  cycles += uint32_t(ARM_DWT_CYCCNT - uint32_t(cycles));
  return cycles;
}

bool host_there() {  // DTR falls when the host's process ends; a cable pulled from a powered board suspends the bus
  return Serial.dtr() && !(USB1_PORTSC1 & USB_PORTSC1_SUSP);
}

void stop(State to, const char *reason) {
  GPIO9_DR = 0;
  timer.end();
  state = to;
  why = reason;
}

void show() { GPIO9_DR = uint32_t(words[place].bits & 7 & (cut || gate_low ? ~GATE : ~0)) << PORT_BIT; }

void enter(uint64_t at) {
  word_start = at;
  marker_low = false;
  cut = (words[place].bits & HELD_GATE) == HELD_GATE && !digitalReadFast(SCAN_PIN);
  cuts += cut;
  show();
}

// The player: an interrupt of the highest priority, from the timer and from every edge of the scan marker. It goes
// through the words that are due, and stays while the next event is near; else it sets the timer. A word takes at least
// 5 us, in which it stays for 2 us at most, so that USB and `abort` get their share whatever the program is.
void play() {
  if (state != PLAYING) return;
  if (!host_there()) return stop(ABORTED, "port");  // checked here, as the main program may hang
  if (now() - beat >= watchdog) return stop(ABORTED, "watchdog");
  for (;;) {
    const Word &w = words[place];
    bool high = digitalReadFast(SCAN_PIN);
    uint64_t t = now(), end = word_start + uint64_t(w.ticks ? w.ticks : SHORTEST) * TICK, next = t + MS;
    if (t >= end && (w.ticks || high)) {
      sweeps += !w.ticks;
      place = place + 1 == n_words ? 0 : place + 1;
      if (place == 0 && ++rounds == repeats) return stop(STOPPED, "end");
      enter(w.ticks ? end : t);  // at its due time, so that lateness does not add up
      continue;
    }
    if (t < end) next = min(next, end);  // else it waits, and the marker's edge ends that
    if ((w.bits & HELD_GATE) == HELD_GATE && !cut) {
      if (!high && !marker_low) low_since = t;
      marker_low = !high;
      cut = marker_low && t - low_since >= hold;
      cuts += cut;
      if (cut) show();
      else if (marker_low) next = min(next, low_since + hold);
    }
    if (next > t + NEAR) {
      timer.begin(play, float(next - t - EARLY) / US);
      return;
    }
  }
}

uint32_t checksum(uint32_t sum, const char *text) {  // CRC-32 of zlib, without its inversions at start and end
  for (; *text; text++) {
    sum ^= uint8_t(*text);
    for (int bit = 0; bit < 8; bit++) sum = sum >> 1 ^ (sum & 1 ? 0xEDB88320 : 0);
  }
  return sum;
}

void reply(const char *format, ...) {
  char text[200];
  int n = snprintf(text, sizeof text, "%s", tag);
  va_list arguments;
  va_start(arguments, format);
  n += vsnprintf(text + n, sizeof text - n, format, arguments);
  va_end(arguments);
  n += snprintf(text + n, sizeof text - n, " *%08x\n", unsigned(~checksum(~0U, text)));
  noInterrupts();
  if (*format == 'o') beat = now();  // only what is answered ok is the host's heartbeat
  interrupts();
  if (Serial.availableForWrite() < n) return;  // nobody reads: to wait would delay `abort`
  Serial.write(text, n);
  Serial.send_now();
}

void reply_status() {
  delayMicroseconds(1);  // until the pins have followed
  noInterrupts();
  const char *name = state != PLAYING ? (state == STOPPED ? "stopped" : "aborted")
                                      : (words[place].ticks ? "running" : "waiting");
  unsigned done = sweeps, at = place, dark = cuts, pins = GPIO9_PSR >> PORT_BIT & 7, marker = digitalReadFast(SCAN_PIN);
  const char *reason = why;
  interrupts();
  reply("ok state=%s sweeps=%u word=%u pins=%u marker=%u cuts=%u why=%s", name, done, at, pins, marker, dark, reason);
}

bool decimal(const char *text, uint32_t least, uint32_t most, uint32_t &value) {
  uint64_t v = 0;
  for (; *text; text++) {
    if (*text < '0' || *text > '9' || (v = 10 * v + (*text - '0')) > most) return false;
  }
  value = v;
  return v >= least;
}

bool hexadecimal(const char *text, uint32_t digits, uint64_t &value) {
  value = strtoull(text, nullptr, 16);
  return strlen(text) == digits && strspn(text, "0123456789abcdef") == digits;
}

const char *fault(const char *text, Word &w) {
  uint64_t value;
  if (!hexadecimal(text, 9, value)) return "9 hex digits";
  w = {uint32_t(value), uint8_t(value >> 32)};
  if (w.ticks) return w.ticks < SHORTEST ? "under 500 ticks" : nullptr;
  return w.bits & GATE ? "waits with gate high" : w.bits & HELD ? "waits and held" : nullptr;
}

void run(uint32_t watchdog_ms) {
  noInterrupts();
  why = "none";
  place = rounds = sweeps = cuts = gate_low = 0;
  watchdog = uint64_t(watchdog_ms) * MS;
  state = PLAYING;
  beat = now();
  enter(beat);
  play();
  interrupts();
}

void lower(bool all) {
  noInterrupts();
  gate_low = true;
  if (all && state == PLAYING) stop(ABORTED, "abort");
  if (state == PLAYING) show();
  else GPIO9_DR = 0;
  interrupts();
}

#define EXPECT(possible, complaint) if (!(possible)) return reply("error " complaint)

void obey(char *text) {
  uint32_t sum = checksum(checksum(strncmp(text, "new ", 4) ? crc : ~0U, text), "\n"), a, b;
  uint64_t wanted;
  char *parts[128];  // a line of 9 digits a word has fewer
  int n = 0;
  for (char *part = strtok(text, " "); part && n < 128; part = strtok(nullptr, " ")) parts[n++] = part;
  auto is = [&](const char *name) { return n && parts[0] == text && strcmp(text, name) == 0; };
  bool loads = is("new") || is("add") || is("end");
  EXPECT(state != PLAYING || !(loads || is("run")), "busy: abort first");
  EXPECT(host_there() || !(loads || is("run")), "port: DTR is low");
  EXPECT(load != LOADED || !is("end"), "complete already");
  Load was = load;
  if (loads) load = EMPTY;  // until the line has turned out right
  if (is("new")) {
    EXPECT(n == 3 && decimal(parts[1], 1, ~0U, a) && decimal(parts[2], 0, ~0U, b), "usage: new REPEATS HOLD");
    repeats = a, hold = uint64_t(b) * TICK, n_words = 0, crc = sum, load = LOADING;
    reply("ok");
  } else if (is("add")) {
    EXPECT(n > 1, "usage: add WORD ...");
    EXPECT(was == LOADING, "no program: new, add, end");
    for (int i = 1; i < n; i++) {
      if (n_words == MAX_WORDS) return reply("error full: %u words", unsigned(MAX_WORDS));
      const char *wrong = fault(parts[i], words[n_words]);
      if (wrong) return reply("error word %u: %s", unsigned(n_words), wrong);
      n_words++;
    }
    crc = sum, load = LOADING;
    reply("ok %u", unsigned(n_words));
  } else if (is("end")) {
    EXPECT(n == 3 && decimal(parts[1], 1, MAX_WORDS, a) && hexadecimal(parts[2], 8, wanted), "usage: end COUNT CRC");
    EXPECT(was == LOADING, "no program: new, add, end");
    if (a != n_words) return reply("error count: %u words came", unsigned(n_words));
    if (wanted != uint32_t(~crc)) return reply("error crc: %08x came", unsigned(~crc));
    load = LOADED;
    reply("ok");
  } else if (is("run")) {
    EXPECT(n == 2 && decimal(parts[1], 1, MAX_WATCHDOG_MS, a), "usage: run WATCHDOG");
    EXPECT(load == LOADED, "no program: new, add, end");
    run(a);
    reply_status();
  } else if (is("id")) {
    EXPECT(n == 1, "usage: id");
    uint32_t serial = HW_OCOTP_MAC0 & 0xFFFFFF;  // as usb_desc.c makes it
    reply("ok spadrig-sync 1 %u words=%u tick_ns=10 shortest=%u", unsigned(serial < 10000000 ? serial * 10 : serial),
          unsigned(MAX_WORDS), unsigned(SHORTEST));
  } else if (is("status") || is("low") || is("abort")) {
    if (n != 1) return reply("error usage: %s", text);
    if (!is("status")) lower(is("abort"));
    reply_status();
  } else {
    reply("error unknown command");
  }
}

void take_line() {
  size_t n = *line == '#' ? strcspn(line, " ") : 0;
  bool tagged = n >= 2 && n <= 9 && line[n] == ' ';
  snprintf(tag, tagged ? n + 2 : 1, "%s", line);
  if (too_long) reply("error line longer than %u bytes", unsigned(LONGEST_LINE));
  else if (length) obey(tagged ? line + n + 1 : line);
  length = too_long = 0;
}

void loop() {
  if (!host_there()) {
    load = EMPTY;
    noInterrupts();
    play();  // which ends the program, even if the port is open again at once
    interrupts();
  }
  while (Serial.available() > 0) {
    int c = Serial.read();
    if (c == '\n') line[length] = 0, take_line();
    else if (c != '\r' && length == LONGEST_LINE) too_long = true;
    else if (c != '\r') line[length++] = c < ' ' ? '?' : c;
  }
}

void setup() {
  GPIO9_DR = 0;  // before they become outputs
  for (int i = 0; i < N_PINS; i++) pinMode(FIRST_PIN + i, OUTPUT);
  pinMode(SCAN_PIN, INPUT_PULLDOWN);  // not connected: low, and the gate with it
  timer.priority(0);
  attachInterrupt(SCAN_PIN, play, CHANGE);
  NVIC_SET_PRIORITY(IRQ_GPIO6789, 0);  // as the timer's, so that neither interrupts the other
}
