/* The edges of the tachos: an interrupt notes time and levels, the loop takes them in order. */
#ifndef EDGES_H
#define EDGES_H

#include <stdbool.h>
#include <stdint.h>

#define TACHO_PINS ((1 << FANS) - 1) /* PC0 and following: A0, A1, A2, A3 */

void edges_start(void);

bool edges_wait(void);

/* The next note, if there is one: when any level changed, and all levels then. */
bool edges_take(uint32_t *at_us, uint8_t *levels);

#endif
