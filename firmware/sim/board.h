/* The firmware on simavr, with four fans, a supply and a serial line on its pins. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include "rotor.h"

#define BOARD_FANS 4
#define STEP_US 1000

/* Load the firmware; ends the process if that fails. vcd: file for the trace of the pins, or NULL. */
void board_start(const char *elf, const char *vcd);

/* Run for one step of STEP_US. */
void board_step(void);

/* Simulated time since the start, over restarts. */
double board_time_s(void);

/* Bytes for the firmware, at the pace of the line; false if the queue is full. */
bool board_send(uint8_t byte, bool with_framing_error);

/* Called with each byte that the firmware sends. */
extern void (*board_on_byte)(uint8_t byte);

rotor_t *board_rotor(int fan);
void board_set_supply(double volts);
void board_set_chip_supply(double volts);

/* A short pulse of this length on a tacho, once a millisecond; 0: none. */
void board_set_noise(int fan, int length_us);

/* The firmware runs no further: an endless loop with interrupts off. */
void board_hang(void);

/* One line of JSON: time, fans, counters of the firmware (as hexadecimal bytes), restarts. */
void board_print_state(FILE *to);

void board_end(void);

#endif
