/* Four fans on an ATmega328P: takes commands and set-points, sends samples. docs/how-to/firmware.md. */
#ifdef __AVR__ /* firmware.ino is for other boards, with the same parts without hardware */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "adc.h"
#include "counters.h"
#include "edges.h"
#include "pwm_clock.h"
#include "tacho.h"
#include "tray.h"
#include "uart.h"

#define SAMPLE_MS (1000 / RATE_HZ)

static tacho_t tachos[FANS];

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
    tray_start();
    for (uint8_t fan = 0; fan < FANS; fan++)
        tacho_start(&tachos[fan], true, 0);
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

static void take_input(void)
{
    int16_t byte;
    while ((byte = uart_receive()) >= 0)
        tray_take(byte);
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
    if (uart_send(line, counters_encode(tray_sequence() / RATE_HZ, counts, line)))
        samples_before = 0;
}

static void sample(void)
{
    measured_t measured = {.supply_v = adc_supply_v()};
    uint16_t glitches = 0, levels[FANS];
    take_edges();
    measured.clock_us = clock_us(); /* after all edges that have been taken */
    for (uint8_t fan = 0; fan < FANS; fan++) {
        tacho_t *tacho = &tachos[fan];
        tacho_settle(tacho, measured.clock_us);
        measured.period_rpm[fan] = tacho_period_rpm(tacho, measured.clock_us);
        measured.pulses[fan] = tacho->pulses;
        glitches += tacho->glitches;
    }
    counters.glitches = glitches;
    uint8_t line[SAMPLE_LINE_BYTES];
    uint8_t length = tray_sample(&measured, levels, line);
    for (uint8_t fan = 0; fan < FANS; fan++)
        pwm_set(fan, levels[fan]);
    if (!uart_send(line, length))
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

#endif
