// Two 4-pin fans: PWM on pins 9 and 10, tachos on pins 2 and 3. Prints and takes lines of docs/reference/wire-protocol.md.
const int FANS = 2, PWM_PIN[FANS] = {9, 10}, TACHO_PIN[FANS] = {2, 3};
const unsigned long STEP_US = 10000, STANDING_US = 500000;
volatile unsigned long pulse_us[FANS], period_us[FANS];
float command[FANS] = {0.5, 0.5};
unsigned long sequence = 0, next_us = 0;

void pulse(int fan) { unsigned long now = micros(); period_us[fan] = now - pulse_us[fan]; pulse_us[fan] = now; }
void pulse0() { pulse(0); }
void pulse1() { pulse(1); }

float rpm(int fan) {                                  // two pulses a turn
  noInterrupts();
  unsigned long period = period_us[fan], since = micros() - pulse_us[fan];
  interrupts();
  return period == 0 || since > STANDING_US ? 0 : 30e6 / period;
}

void take_commands() {                                // lines such as "C 1 0.75"
  static char line[32];
  static byte length = 0;
  while (Serial.available()) {
    char c = Serial.read();
    if (c != '\n') { if (length < sizeof line - 1) line[length++] = c; continue; }
    line[length] = 0;
    length = 0;
    char *rest;
    long fan = strtol(line + 1, &rest, 10);
    if (line[0] == 'C' && fan >= 0 && fan < FANS) command[fan] = constrain(strtod(rest, NULL), 0, 1);
  }
}

void setup() {
  Serial.begin(115200);
  for (int i = 0; i < FANS; i++) { pinMode(PWM_PIN[i], OUTPUT); pinMode(TACHO_PIN[i], INPUT_PULLUP); }
  attachInterrupt(digitalPinToInterrupt(TACHO_PIN[0]), pulse0, FALLING);
  attachInterrupt(digitalPinToInterrupt(TACHO_PIN[1]), pulse1, FALLING);
}

void loop() {
  take_commands();
  if ((long)(micros() - next_us) < 0) return;
  unsigned long clock_us = micros();
  next_us += STEP_US;
  Serial.print("S "); Serial.print(clock_us); Serial.print(' '); Serial.print(sequence++);
  for (int i = 0; i < FANS; i++) {
    analogWrite(PWM_PIN[i], (int)(255 * command[i]));
    Serial.print(' '); Serial.print(command[i], 3); Serial.print(' '); Serial.print(rpm(i), 1);
  }
  Serial.println();
}
