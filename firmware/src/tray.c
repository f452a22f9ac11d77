#include "tray.h"

#include <math.h>

#include "counters.h"
#include "tacho.h"

#define SAMPLE_MS (1000 / RATE_HZ)
#define WINDOW_SAMPLES (WINDOW_MS / SAMPLE_MS)

volatile counters_t counters;
static fan_t fans[FANS];
static host_t host;
static receiver_t receiver;
static uint32_t sequence;

/* What the next sample is to apply; NaN: nothing new. A command acts from a sample on, so that the sample says exactly
 * since when. */
static float new_duty[FANS], new_set_point[FANS];

/* Where pulses are counted: at the start of the window, samples since then, and what the last window gave. */
static uint16_t pulses_before[FANS], samples_of_window;
static float counted_rpm[FANS];

void tray_start(void)
{
    for (uint8_t fan = 0; fan < FANS; fan++) {
        fan_start(&fans[fan]);
        new_duty[fan] = new_set_point[fan] = NAN;
        counted_rpm[fan] = NAN;
    }
}

static void take_frame(const float values[FANS], float into[FANS], float instead_of[FANS])
{
    count(&counters.frames);
    host_commanded(&host);
    for (uint8_t fan = 0; fan < FANS; fan++) {
        if (isnan(values[fan]))
            continue;
        into[fan] = values[fan];
        instead_of[fan] = NAN;
    }
}

void tray_take(uint8_t byte)
{
    float values[FANS];
    switch (receiver_take(&receiver, byte, values)) {
    case RECEIVED_NOTHING:
        break;
    case RECEIVED_COMMAND:
        take_frame(values, new_duty, new_set_point);
        break;
    case RECEIVED_SET_POINT:
        take_frame(values, new_set_point, new_duty);
        break;
    case RECEIVED_BAD_LENGTH:
        count(&counters.bad_length);
        break;
    case RECEIVED_BAD_CRC:
        count(&counters.bad_crc);
        break;
    case RECEIVED_WRONG_KIND:
        count(&counters.wrong_kind);
        break;
    case RECEIVED_BAD_VALUE:
        count(&counters.bad_value);
        break;
    }
}

/* The level of a fan from this sample on. */
static uint16_t drive(uint8_t fan, float speed_rpm, bool host_is_silent)
{
    if (host_is_silent)
        fan_set_duty(&fans[fan], 1.0f);
    else if (!isnan(new_duty[fan]))
        fan_set_duty(&fans[fan], new_duty[fan]);
    else if (!isnan(new_set_point[fan]))
        fan_set_speed(&fans[fan], new_set_point[fan], speed_rpm);
    new_duty[fan] = new_set_point[fan] = NAN;
    fan_step(&fans[fan], speed_rpm);
    return fan_level(&fans[fan]);
}

/* What the host is shown of the speed. */
static float measured_rpm(uint8_t fan, uint16_t pulses, float period_rpm)
{
    if (!MEASURE_COUNT)
        return period_rpm;
    if (samples_of_window == 0) {
        if (sequence > 0) /* a window has ended */
            counted_rpm[fan] = tacho_count_rpm(pulses - pulses_before[fan]);
        pulses_before[fan] = pulses;
    }
    return counted_rpm[fan];
}

uint8_t tray_sample(const measured_t *measured, uint16_t levels[FANS], uint8_t line[SAMPLE_LINE_BYTES])
{
    sample_t sample = {.clock_us = measured->clock_us, .sequence = sequence, .supply_v = measured->supply_v};
    bool host_is_silent = host_falls_silent(&host);
    if (host_is_silent)
        count(&counters.host_silences);
    for (uint8_t fan = 0; fan < FANS; fan++) {
        sample.speed_rpm[fan] = measured_rpm(fan, measured->pulses[fan], measured->period_rpm[fan]);
        levels[fan] = drive(fan, measured->period_rpm[fan], host_is_silent);
        sample.command[fan] = (float)levels[fan] / PWM_STEPS;
    }
    sequence++;
    if (++samples_of_window == WINDOW_SAMPLES)
        samples_of_window = 0;
    return sample_encode(&sample, line);
}

uint32_t tray_sequence(void)
{
    return sequence;
}
