// A Teensy on a PC, as far as config/firmware/teensy/teensy.ino needs one: time moves only in here. The script on stdin
// has lines `CYCLE send HEX`, `CYCLE marker 0|1`, `CYCLE dtr 0|1`, `CYCLE suspend 0|1`, `CYCLE end`, ascending; on stdout
// come `CYCLE pins N` for each change and `CYCLE said LINE`.
#include <algorithm>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <iostream>
#include <string>
#include <vector>

#define F_CPU 600000000
enum { OUTPUT = 1, INPUT_PULLDOWN = 3, CHANGE = 4, IRQ_GPIO6789 = 157, USB_PORTSC1_SUSP = 1 << 7 };
typedef void (*Function)();
using std::min;

namespace sim {
const uint64_t NEVER = ~0ULL, LOOK = 25, ENTRY = 60;  // cycles of a look at the clock, and of entering an interrupt
inline uint64_t at = 0, timer_at = NEVER;
inline Function timer_call, edge_call;
inline std::deque<std::pair<uint64_t, int>> edges;  // of the marker: those to come, and the last one that has been
inline std::string received;
}  // namespace sim
inline uint32_t USB1_PORTSC1 = 0, HW_OCOTP_MAC0 = 123456;

struct Port {  // GPIO9
  uint32_t levels = 0;
  void operator=(uint32_t value) {
    if (value != levels) printf("%llu pins %u\n", (unsigned long long)sim::at, value >> 4);
    levels = value;
  }
};
inline Port GPIO9_DR;
#define GPIO9_PSR (GPIO9_DR.levels)
#define ARM_DWT_CYCCNT (uint32_t(sim::at += sim::LOOK))

inline int digitalReadFast(int) {
  int level = 0;
  for (auto &edge : sim::edges) level = edge.first <= sim::at ? edge.second : level;
  return level;
}
struct IntervalTimer {
  void priority(int) {}
  void end() { sim::timer_at = sim::NEVER; }
  bool begin(Function call, float us) {
    sim::timer_call = call;
    sim::timer_at = sim::at + uint64_t(uint32_t(24 * us - 0.5f) + 1) * 25;
    return 24 * us - 0.5f >= 17;
  }
};
struct Usb {
  int dtr_level = 1;
  int dtr() { return dtr_level; }
  int available() { return sim::received.size(); }
  int read() { int c = uint8_t(sim::received[0]); sim::received.erase(0, 1); return c; }
  int availableForWrite() { return 6144; }
  void write(const char *text, int n) { printf("%llu said %.*s", (unsigned long long)sim::at, n, text); }
  void send_now() {}
};
inline Usb Serial;
inline void pinMode(int, int) {}
inline void attachInterrupt(int, Function call, int) { sim::edge_call = call; }
inline void noInterrupts() {}
inline void interrupts() {}
inline void delayMicroseconds(int us) { sim::at += us * (F_CPU / 1000000); }
#define NVIC_SET_PRIORITY(irq, priority)
