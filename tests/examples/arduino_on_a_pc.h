// An Arduino on a PC, for a second of its own time: pulses every 10 ms on pin 2, none on pin 3, a command after half of it.
#include <cstdio>
#include <cstdlib>
#include <cstring>

typedef unsigned char byte;
enum { INPUT_PULLUP, OUTPUT, FALLING };
static unsigned long now_us = 0;
static void (*handlers[4])();
static int duties[14];
static const char *typed = "";

static unsigned long micros() { return now_us; }
static void noInterrupts() {}
static void interrupts() {}
static void pinMode(int, int) {}
static int digitalPinToInterrupt(int pin) { return pin; }
static void attachInterrupt(int pin, void (*handler)(), int) { handlers[pin] = handler; }
static void analogWrite(int pin, int duty) { duties[pin] = duty; }
static double constrain(double value, double low, double high) { return value < low ? low : value > high ? high : value; }

static struct {
  void begin(long) {}
  int available() { return strlen(typed); }
  int read() { return *typed++; }
  void print(const char *text) { printf("%s", text); }
  void print(char letter) { printf("%c", letter); }
  void print(unsigned long number) { printf("%lu", number); }
  void print(double number, int digits) { printf("%.*f", digits, number); }
  void println() { printf("\r\n"); }
} Serial;

void setup();
void loop();

int main() {
  setup();
  for (; now_us < 1000000; now_us += 100) {
    if (now_us % 10000 == 0) handlers[2]();
    if (now_us == 500000) typed = "C 1 0.75\nC 2 0.1\nnonsense\n";
    loop();
  }
  printf("# duties %d %d\n", duties[9], duties[10]);
}
