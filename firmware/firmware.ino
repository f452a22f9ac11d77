/* Four fans on an ESP32 or a Raspberry Pi Pico, with Arduino-ESP32 (3.0 or later) or Arduino-Pico: docs/how-to/firmware.md.
 * Everything without hardware is that of the Uno, whose own part is src/main.c. */
#ifndef __AVR__
extern "C" {
#include "src/counters.h"
#include "src/frame.h"
#include "src/tacho.h"
#include "src/tray.h"
}

#if defined(ESP32)
#if ESP_ARDUINO_VERSION_MAJOR < 3
#error "Arduino-ESP32 3.0 or later: ledcAttach"
#endif
static const uint8_t PWM_PIN[] = {25, 26, 27, 32}, TACHO_PIN[] = {18, 19, 21, 22};
#elif defined(ARDUINO_ARCH_RP2040)
static const uint8_t PWM_PIN[] = {2, 4, 6, 8}, TACHO_PIN[] = {3, 5, 7, 9};
#else
#error "boards: ESP32, or those of Arduino-Pico"
#endif

/* The pins give 3.3 V and take no more, and a fan pulls its PWM up to 5 V: an N-channel transistor (2N7000) between them,
 * which inverts. Without a signal the fan turns at full speed. */
#ifndef PWM_INVERTED
#define PWM_INVERTED 1
#endif
#define PWM_HZ 25000
#define ESP32_PWM_BITS 10
#define SAMPLE_US (1000000UL / RATE_HZ)

static tacho_t tachos[FANS];

static void edge(uint8_t fan)
{
    tacho_edge(&tachos[fan], digitalRead(TACHO_PIN[fan]) != LOW, micros());
}
static void edge0() { edge(0); }
#if FANS > 1
static void edge1() { edge(1); }
#endif
#if FANS > 2
static void edge2() { edge(2); }
#endif
#if FANS > 3
static void edge3() { edge(3); }
#endif
static void (*const EDGES_OF[FANS])() = {
    edge0,
#if FANS > 1
    edge1,
#endif
#if FANS > 2
    edge2,
#endif
#if FANS > 3
    edge3,
#endif
};

static void set_level(uint8_t fan, uint16_t level)
{
    uint32_t shown = PWM_INVERTED ? PWM_STEPS - level : level;
#if defined(ESP32)
    ledcWrite(PWM_PIN[fan], (shown << ESP32_PWM_BITS) / PWM_STEPS);
#else
    analogWrite(PWM_PIN[fan], shown);
#endif
}

static void send(const uint8_t *line, uint8_t length)
{
    if (Serial.availableForWrite() < length)
        count(&counters.unsent_samples);
    else
        Serial.write(line, length);
}

static void sample()
{
    measured_t measured = {};
    uint16_t glitches = 0, levels[FANS];
    noInterrupts();
    measured.clock_us = micros(); /* after all edges that have been taken */
    for (uint8_t fan = 0; fan < FANS; fan++) {
        tacho_settle(&tachos[fan], measured.clock_us);
        measured.period_rpm[fan] = tacho_period_rpm(&tachos[fan], measured.clock_us);
        measured.pulses[fan] = tachos[fan].pulses;
        glitches += tachos[fan].glitches;
    }
    interrupts();
    counters.glitches = glitches;
    uint8_t line[SAMPLE_LINE_BYTES], counted_line[COUNTERS_LINE_BYTES];
    uint8_t length = tray_sample(&measured, levels, line);
    for (uint8_t fan = 0; fan < FANS; fan++)
        set_level(fan, levels[fan]);
    send(line, length);
    if (tray_sequence() % RATE_HZ == 0) {
        uint16_t counts[COUNTERS];
        memcpy(counts, (const void *)&counters, sizeof counts); /* the interrupts write none of them */
        send(counted_line, counters_encode(tray_sequence() / RATE_HZ, counts, counted_line));
    }
}

void setup()
{
    Serial.begin(BAUD);
#if !defined(ESP32)
    analogWriteFreq(PWM_HZ);
    analogWriteRange(PWM_STEPS);
#endif
    tray_start();
    for (uint8_t fan = 0; fan < FANS; fan++) {
#if defined(ESP32)
        ledcAttach(PWM_PIN[fan], PWM_HZ, ESP32_PWM_BITS);
#else
        pinMode(PWM_PIN[fan], OUTPUT);
#endif
        set_level(fan, PWM_STEPS);
        pinMode(TACHO_PIN[fan], INPUT_PULLUP);
        tacho_start(&tachos[fan], true, micros());
        attachInterrupt(digitalPinToInterrupt(TACHO_PIN[fan]), EDGES_OF[fan], CHANGE);
    }
}

void loop()
{
    static uint32_t next_us = micros();
    while (Serial.available() > 0)
        tray_take(Serial.read());
    if ((int32_t)(micros() - next_us) < 0)
        return;
    next_us += SAMPLE_US;
    sample();
}
#endif
