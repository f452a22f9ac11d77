/* Four channels of 25 kHz PWM and, from the same timer, the clock.
 *
 * Timer 1 counts 640 cycles of 16 MHz: fans 0 and 1, in 640 steps. Timers 2 and 0 count 80 steps of 8 cycles: fans 2
 * and 3. What their step cannot show they show in the mean over 8 ms. Each overflow of timer 1 is 40 us of the clock;
 * its counter is what has passed since. */
#ifndef PWM_CLOCK_H
#define PWM_CLOCK_H

#include <avr/io.h>
#include <stdbool.h>
#include <stdint.h>

#include "fan.h"

/* All fans at full speed, and the clock starts at 0. Interrupts are off. */
void pwm_clock_start(void);

void pwm_set(uint8_t fan, uint16_t level);

/* Once a millisecond: what fans 2 and 3 show of their levels. */
void pwm_step(void);

/* What passes at each overflow of timer 1, and when it was: parts of the clock, for interrupts that read it. */
extern volatile uint32_t clock_overflows_us;
extern volatile uint8_t clock_overflows_of_ms, clock_ms;

#define CLOCK_US_PER_OVERFLOW 40
#define CLOCK_OVERFLOWS_PER_MS 25
#define CLOCK_CYCLES_PER_US 16

static inline void clock_count_overflow(void)
{
    clock_overflows_us += CLOCK_US_PER_OVERFLOW;
    uint8_t overflows = clock_overflows_of_ms + 1;
    if (overflows == CLOCK_OVERFLOWS_PER_MS) {
        overflows = 0;
        clock_ms++;
    }
    clock_overflows_of_ms = overflows;
}

/* The counter of timer 1 now, which belongs to clock_overflows_us. With interrupts off. An overflow whose interrupt
 * waits is counted here: interrupts of tachos come before it, and many of them must not hide the next. */
static inline uint16_t clock_counter(void)
{
    uint16_t counter = TCNT1;
    if (TIFR1 & _BV(TOV1)) {
        TIFR1 = _BV(TOV1);
        clock_count_overflow();
        counter = TCNT1; /* the one before may be of before the overflow */
    }
    return counter;
}

/* Microseconds since the start, wraps at 2^32. */
uint32_t clock_us(void);

/* Milliseconds since the start, wraps at 256. */
static inline uint8_t clock_elapsed_ms(void)
{
    return clock_ms;
}

#endif
