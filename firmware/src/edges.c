#ifdef __AVR__
#include "edges.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "counters.h"
#include "pwm_clock.h"
#include "settings.h"

#define SIZE 32 /* four fans at 20,000 rpm have 12 edges in the 2 ms for which the loop may be busy */

/* A ring: the interrupt moves `to`, the loop `from`; one place stays free. */
static volatile uint32_t overflows_us[SIZE];
static volatile uint16_t counters_then[SIZE];
static volatile uint8_t levels_then[SIZE];
static volatile uint8_t from, to;

void edges_start(void)
{
    DDRC &= ~TACHO_PINS;
    PORTC |= TACHO_PINS; /* pull-ups of 20 to 50 kOhm: those on the board are stronger */
    PCMSK1 = TACHO_PINS;
    PCICR = _BV(PCIE1);
}

ISR(PCINT1_vect)
{
    uint16_t counter = clock_counter();
    uint8_t at = to, next = (at + 1) % SIZE;
    if (next == from) {
        count(&counters.lost_edges);
        return;
    }
    levels_then[at] = PINC;
    counters_then[at] = counter;
    overflows_us[at] = clock_overflows_us;
    to = next;
}

bool edges_wait(void)
{
    return from != to;
}

bool edges_take(uint32_t *at_us, uint8_t *levels)
{
    uint8_t at = from;
    if (at == to)
        return false;
    *at_us = overflows_us[at] + counters_then[at] / CLOCK_CYCLES_PER_US;
    *levels = levels_then[at];
    from = (at + 1) % SIZE;
    return true;
}
#endif
