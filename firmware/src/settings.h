/* What is chosen when the firmware is built: `make -C firmware RATE_HZ=20 MEASURE=count`. docs/how-to/firmware.md
 * explains each. */
#ifndef SETTINGS_H
#define SETTINGS_H

#ifndef FANS
#define FANS 4
#endif
#ifndef RATE_HZ /* samples a second */
#define RATE_HZ 50
#endif
#ifndef BAUD
#define BAUD 115200UL
#endif
#ifndef PULSES /* of the tacho, a revolution */
#define PULSES 2
#endif
#ifndef MEASURE_COUNT /* 0: speed of the last revolution; 1: pulses counted over WINDOW_MS */
#define MEASURE_COUNT 0
#endif
#ifndef WINDOW_MS
#define WINDOW_MS 1000
#endif
#ifndef STANDING_MS /* no pulse for so long: the fan stands */
#define STANDING_MS 500
#endif
#ifndef GLITCH_US /* a level of the tacho that lasts less is noise */
#define GLITCH_US 100
#endif
#ifndef SPEED_MAX_RPM /* a larger set-point is refused */
#define SPEED_MAX_RPM 20000
#endif
#ifndef HOST_SILENCE_S /* full speed if a host that has commanded is silent for so long; 0: never */
#define HOST_SILENCE_S 60
#endif
#ifndef LOOP_DUTY_PER_1000_RPM /* speed loop: duty for each 1000 rpm of error, at once */
#define LOOP_DUTY_PER_1000_RPM 0.1
#endif
#ifndef LOOP_TIME_S /* and the time in which the integral adds as much again; about the fan's time constant */
#define LOOP_TIME_S 0.8
#endif
#ifndef SUPPLY /* 1: the supply of the fans is measured */
#if defined(ESP32) || defined(ARDUINO_ARCH_RP2040)
#define SUPPLY 0
#else
#define SUPPLY 1
#endif
#endif
#ifndef DIVIDER_HIGH_OHM /* from the supply to the pin */
#define DIVIDER_HIGH_OHM 33000
#endif
#ifndef DIVIDER_LOW_OHM /* from the pin to ground */
#define DIVIDER_LOW_OHM 10000
#endif
#ifndef BANDGAP_MV /* the chip's own reference: 1000 to 1200 from chip to chip, to be measured once */
#define BANDGAP_MV 1100
#endif

#if FANS < 1 || FANS > 4
#error "FANS: there are pins for 1 to 4 fans"
#endif
#if RATE_HZ < 10 || RATE_HZ > 100 || 1000 % RATE_HZ != 0
#error "RATE_HZ: 10, 20, 25, 40, 50 or 100"
#endif
#if (WINDOW_MS * RATE_HZ) % 1000 != 0 || WINDOW_MS < 100
#error "WINDOW_MS: at least 100, and a whole number of samples"
#endif
#if PULSES < 1 || PULSES > 8
#error "PULSES: 1 to 8 a revolution"
#endif
/* Samples of FANS fans must leave at their rate, and once a second the counters (see frame.h): 10 bits a byte. */
#if ((18 + 4 * FANS * (SUPPLY ? 3 : 2) + 1) * RATE_HZ + 38) * 10 > BAUD
#error "BAUD is too low for that many fans at RATE_HZ"
#endif

#endif
