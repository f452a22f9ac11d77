/* The serial line, in both directions through rings that interrupts empty and fill. Nothing waits. */
#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stdint.h>

void uart_start(void);

/* Send a whole frame, or nothing of it if it does not fit; returns whether it is sent. */
bool uart_send(const uint8_t *bytes, uint8_t length);

bool uart_has_received(void);

/* The next byte received, or -1. */
int16_t uart_receive(void);

#endif
