#ifdef __AVR__
#include "uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "counters.h"
#include "settings.h"

#define OUT_SIZE 128 /* more than a sample and the counters */
#define IN_SIZE 64   /* what comes in 5 ms at 115200 baud */
#define DIVISOR ((F_CPU + 4 * BAUD) / (8 * BAUD))

_Static_assert(DIVISOR >= 1 && DIVISOR <= 4096, "BAUD is out of range");
_Static_assert(100 * F_CPU / 8 / DIVISOR > 97 * BAUD && 100 * F_CPU / 8 / DIVISOR < 103 * BAUD,
               "16 MHz cannot make this BAUD within 3 %");

/* Rings: one side moves `from`, the other `to`; one place stays free. */
static volatile uint8_t out[OUT_SIZE], out_from, out_to;
static volatile uint8_t in[IN_SIZE], in_from, in_to;

void uart_start(void)
{
    UCSR0A = _BV(U2X0);
    UBRR0 = DIVISOR - 1;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

ISR(USART_RX_vect)
{
    uint8_t status = UCSR0A, at = in_to, next = (at + 1) % IN_SIZE;
    in[at] = UDR0;
    if (status & (_BV(FE0) | _BV(UPE0)))
        count(&counters.line_errors);
    if (status & _BV(DOR0))
        count(&counters.overruns);
    if (next == in_from)
        count(&counters.overruns);
    else
        in_to = next;
}

ISR(USART_UDRE_vect)
{
    uint8_t at = out_from;
    if (at == out_to) {
        UCSR0B &= ~_BV(UDRIE0);
        return;
    }
    UDR0 = out[at];
    out_from = (at + 1) % OUT_SIZE;
}

bool uart_send(const uint8_t *bytes, uint8_t length)
{
    uint8_t at = out_to, used = (uint8_t)(at - out_from) % OUT_SIZE;
    if (used + length >= OUT_SIZE)
        return false;
    while (length--) {
        out[at] = *bytes++;
        at = (at + 1) % OUT_SIZE;
    }
    out_to = at;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        UCSR0B |= _BV(UDRIE0);
    }
    return true;
}

bool uart_has_received(void)
{
    return in_from != in_to;
}

int16_t uart_receive(void)
{
    uint8_t at = in_from;
    if (at == in_to)
        return -1;
    uint8_t byte = in[at];
    in_from = (at + 1) % IN_SIZE;
    return byte;
}
#endif
