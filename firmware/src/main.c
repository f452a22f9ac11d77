/* Four fans on an ATmega328P: takes commands and set-points, sends samples. docs/how-to/firmware.md. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <math.h>
#include <util/atomic.h>

#include "adc.h"
#include "counters.h"
#include "edges.h"
#include "fan.h"
#include "frame.h"
#include "pwm_clock.h"
#include "tacho.h"
#include "uart.h"

#define SAMPLE_MS (1000 / RATE_HZ)
#define WINDOW_SAMPLES (WINDOW_MS / SAMPLE_MS)

volatile counters_t counters;
static tacho_t tachos[FANS];
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

/* The watchdog stays on after its reset, with its shortest time: off before anything else. */
static uint8_t reset_causes __attribute__((section(".noinit")));
void keep_reset_causes(void) __attribute__((naked, used, section(".init3")));
void keep_reset_causes(void)
{
    reset_causes = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

static void start(void)
{
    pwm_clock_start();
    for (uint8_t fan = 0; fan < FANS; fan++) {
        fan_start(&fans[fan]);
        new_duty[fan] = new_set_point[fan] = NAN;
        tacho_start(&tachos[fan], true, 0);
        counted_rpm[fan] = NAN;
    }
    edges_start();
    adc_start();
    uart_start();
    counters.watchdog_resets = reset_causes & _BV(WDRF) ? 1 : 0;
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_250MS);
    sei();
}

static void take_edges(void)
{
    static uint8_t levels_before = TACHO_PINS;
    uint32_t at_us;
    uint8_t levels;
    while (edges_take(&at_us, &levels)) {
        uint8_t changed = levels ^ levels_before;
        levels_before = levels;
        for (uint8_t fan = 0; fan < FANS; fan++, changed >>= 1, levels >>= 1)
            if (changed & 1)
                tacho_edge(&tachos[fan], levels & 1, at_us);
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

static void take_input(void)
{
    int16_t byte;
    float values[FANS];
    while ((byte = uart_receive()) >= 0) {
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
}

/* The duty of a fan from this sample on, 0 to 1. */
static float drive(uint8_t fan, float speed_rpm, bool host_is_silent)
{
    if (host_is_silent)
        fan_set_duty(&fans[fan], 1.0f);
    else if (!isnan(new_duty[fan]))
        fan_set_duty(&fans[fan], new_duty[fan]);
    else if (!isnan(new_set_point[fan]))
        fan_set_speed(&fans[fan], new_set_point[fan], speed_rpm);
    new_duty[fan] = new_set_point[fan] = NAN;
    fan_step(&fans[fan], speed_rpm);
    uint16_t level = fan_level(&fans[fan]);
    pwm_set(fan, level);
    return (float)level / PWM_STEPS;
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

/* Once a second: what the board has counted. If the line has no room, the next sample tries again. */
static void send_counters(void)
{
    static uint8_t samples_before = RATE_HZ - 1;
    if (samples_before < RATE_HZ - 1) {
        samples_before++;
        return;
    }
    uint16_t counts[COUNTERS];
    for (uint8_t i = 0; i < COUNTERS; i++)
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) /* one by one, so that no edge waits for all of them */
        {
            counts[i] = ((const volatile uint16_t *)&counters)[i];
        }
    uint8_t line[COUNTERS_LINE_BYTES];
    if (uart_send(line, counters_encode(sequence / RATE_HZ, counts, line)))
        samples_before = 0;
}

static void sample(void)
{
    sample_t sample = {.sequence = sequence, .supply_v = adc_supply_v()};
    bool host_is_silent = host_falls_silent(&host);
    if (host_is_silent)
        count(&counters.host_silences);
    uint16_t glitches = 0;
    take_edges();
    sample.clock_us = clock_us(); /* after all edges that have been taken */
    for (uint8_t fan = 0; fan < FANS; fan++) {
        tacho_t *tacho = &tachos[fan];
        tacho_settle(tacho, sample.clock_us);
        float period_rpm = tacho_period_rpm(tacho, sample.clock_us);
        sample.speed_rpm[fan] = measured_rpm(fan, tacho->pulses, period_rpm);
        sample.command[fan] = drive(fan, period_rpm, host_is_silent);
        glitches += tacho->glitches;
    }
    counters.glitches = glitches;
    sequence++;
    if (++samples_of_window == WINDOW_SAMPLES)
        samples_of_window = 0;
    uint8_t line[SAMPLE_LINE_BYTES];
    if (!uart_send(line, sample_encode(&sample, line)))
        count(&counters.unsent_samples);
    send_counters();
}

int main(void)
{
    start();
    uint8_t ms_of_sample = 0, ms_done = 0;
    for (;;) {
        take_input();
        take_edges();
        for (; ms_done != clock_elapsed_ms(); ms_done++) {
            wdt_reset(); /* so it needs both: the interrupt that counts and the loop that works */
            pwm_step();
            if (SUPPLY)
                adc_step();
            if (++ms_of_sample == SAMPLE_MS) {
                ms_of_sample = 0;
                sample();
            }
        }
        while (ms_done == clock_elapsed_ms() && !uart_has_received() && !edges_wait())
            sleep_mode(); /* until the next interrupt, 40 us at most */
    }
}
