#ifdef __AVR__
#include "pwm_clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#define COARSE_STEPS 80
#define FINE_PER_COARSE (PWM_STEPS / COARSE_STEPS)

_Static_assert(F_CPU == 16000000UL, "the timers are set for 16 MHz");
_Static_assert(PWM_STEPS * 25000UL == F_CPU, "25 kHz");

volatile uint32_t clock_overflows_us;
volatile uint8_t clock_overflows_of_ms, clock_ms;

/* Of fans 2 and 3: wanted level in fine steps, what is still owed, and the coarse level that is set. */
static uint16_t wanted[2];
static uint8_t owed[2], is_set[2];

/* Fan i is on: OC1A, OC1B, OC2B, OC0B. */
void pwm_clock_start(void)
{
    const uint8_t on_b = _BV(PB1) | _BV(PB2), on_d = _BV(PD3) | _BV(PD5);
    PORTB |= on_b; /* first high, then an output: never a moment without full speed */
    PORTD |= on_d;
    DDRB |= on_b;
    DDRD |= on_d;

    ICR1 = PWM_STEPS - 1;
    OCR1A = OCR1B = PWM_STEPS - 1;
    OCR2A = OCR0A = COARSE_STEPS - 1;
    OCR2B = OCR0B = COARSE_STEPS - 1;
    wanted[0] = wanted[1] = PWM_STEPS;
    is_set[0] = is_set[1] = COARSE_STEPS;
    TCCR1A = _BV(COM1A1) | _BV(COM1B1) | _BV(WGM11);
    TCCR2A = _BV(COM2B1) | _BV(WGM21) | _BV(WGM20);
    TCCR0A = _BV(COM0B1) | _BV(WGM01) | _BV(WGM00);
    TIMSK1 = _BV(TOIE1);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    TCCR2B = _BV(WGM22) | _BV(CS21);
    TCCR0B = _BV(WGM02) | _BV(CS01);
    PORTB &= ~on_b; /* what a channel shows that is taken off its timer: 0 */
    PORTD &= ~on_d;
}

/* Fast PWM is high for one step more than its compare value, so never quite off: off is without the timer. */
static void set_fine(uint8_t fan, uint16_t level)
{
    uint8_t connected = fan == 0 ? _BV(COM1A1) : _BV(COM1B1);
    if (level == 0) {
        TCCR1A &= ~connected;
        return;
    }
    if (fan == 0)
        OCR1A = level - 1;
    else
        OCR1B = level - 1;
    TCCR1A |= connected;
}

static void set_coarse(uint8_t channel, uint8_t level)
{
    if (level == is_set[channel])
        return;
    is_set[channel] = level;
    if (channel == 0) {
        if (level > 0)
            OCR2B = level - 1;
        TCCR2A = (level > 0 ? _BV(COM2B1) : 0) | _BV(WGM21) | _BV(WGM20);
    } else {
        if (level > 0)
            OCR0B = level - 1;
        TCCR0A = (level > 0 ? _BV(COM0B1) : 0) | _BV(WGM01) | _BV(WGM00);
    }
}

/* The coarse level whose mean over eight calls is the wanted one. */
static void set_coarse_mean(uint8_t channel)
{
    uint16_t level = wanted[channel];
    uint8_t coarse = level / FINE_PER_COARSE;
    owed[channel] += level % FINE_PER_COARSE;
    if (owed[channel] >= FINE_PER_COARSE) {
        owed[channel] -= FINE_PER_COARSE;
        coarse++;
    }
    set_coarse(channel, coarse);
}

void pwm_set(uint8_t fan, uint16_t level)
{
    if (level > PWM_STEPS)
        level = PWM_STEPS;
    if (fan >= 2)
        wanted[fan - 2] = level;
    else
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) /* the clock reads another register through the same high byte */
        {
            set_fine(fan, level);
        }
}

void pwm_step(void)
{
    set_coarse_mean(0);
    set_coarse_mean(1);
}

ISR(TIMER1_OVF_vect)
{
    clock_count_overflow();
}

uint32_t clock_us(void)
{
    uint32_t overflows_us;
    uint16_t counter;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        counter = clock_counter();
        overflows_us = clock_overflows_us;
    }
    return overflows_us + counter / CLOCK_CYCLES_PER_US;
}
#endif
