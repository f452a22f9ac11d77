/* What the board does with frames of the host, and at each sample, whatever board it is. No hardware. */
#ifndef TRAY_H
#define TRAY_H

#include <stdbool.h>
#include <stdint.h>

#include "fan.h"
#include "frame.h"

/* All fans at full speed, and nothing has been received. */
void tray_start(void);

/* Take one byte of the line. */
void tray_take(uint8_t byte);

/* What has been measured for a sample: the clock, and of each fan the speed of the last revolution and its pulses since
 * the start; the supply. */
typedef struct {
    uint32_t clock_us;
    float period_rpm[FANS];
    uint16_t pulses[FANS];
    float supply_v;
} measured_t;

/* Command the fans and write the sample as it goes onto the line; returns its length. levels: of the fans from now on,
 * in steps of PWM_STEPS. */
uint8_t tray_sample(const measured_t *measured, uint16_t levels[FANS], uint8_t line[SAMPLE_LINE_BYTES]);

/* Number of the next sample. */
uint32_t tray_sequence(void);

#endif
