// An ESP32 or a Pico on a PC, for two seconds of its own time: the tacho of fan 0 gives a pulse every 10 ms, the others
// none. What is typed on standard input comes after one second. Shows on standard error what the PWM pins have.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <map>
#include <string>

enum { INPUT_PULLUP, OUTPUT, CHANGE, LOW = 0, HIGH = 1 };
#ifdef ESP32
#define ESP_ARDUINO_VERSION_MAJOR 3
#endif
static unsigned long now_us = 0;
static std::map<int, void (*)()> handlers;
static std::map<int, int> levels, duties;
static std::string typed, received;
static bool are_interrupts_on = true;

static unsigned long micros() { return now_us; }
static void noInterrupts() { are_interrupts_on = false; }
static void interrupts() { are_interrupts_on = true; }
static void pinMode(int pin, int mode) { if (mode == INPUT_PULLUP) levels[pin] = HIGH; }
static int digitalRead(int pin) { return levels[pin]; }
static int digitalPinToInterrupt(int pin) { return pin; }
static void attachInterrupt(int pin, void (*handler)(), int) { handlers[pin] = handler; }
#ifdef ESP32
static bool ledcAttach(int, unsigned long hz, int bits) { return hz == 25000 && bits == 10; }
static void ledcWrite(int pin, unsigned long duty) { duties[pin] = duty; }
#else
static void analogWriteFreq(unsigned long) {}
static void analogWriteRange(unsigned long) {}
static void analogWrite(int pin, int duty) { duties[pin] = duty; }
#endif

static struct {
  void begin(unsigned long) {}
  int available() { return received.size(); }
  int read() { int byte = (uint8_t)received[0]; received.erase(0, 1); return byte; }
  int availableForWrite() { return 128; }
  void write(const uint8_t *bytes, size_t count) { fwrite(bytes, 1, count, stdout); }
} Serial;

void setup();
void loop();

int main() {
  char buffer[4096];
  typed.assign(buffer, fread(buffer, 1, sizeof buffer, stdin));
  setup();
  int tacho = handlers.begin()->first;
  for (; now_us < 2000000; now_us += 100) {
    if (now_us % 5000 == 0) {
      levels[tacho] = !levels[tacho];
      handlers[tacho]();
    }
    if (now_us == 1000000) received = typed;
    loop();
    if (!are_interrupts_on) return 1;
  }
  for (auto each : duties) fprintf(stderr, "%d ", each.second);
}
