/* A tacho: edges with their times in, speed out. No hardware; all times are microseconds that wrap at 2^32.
 *
 * A level counts once it has lasted GLITCH_US, with the time at which it began: a short pulse moves nothing, and what
 * lasts keeps its exact time. A pulse is a change from high to low (the output of a fan is an open collector). */
#ifndef TACHO_H
#define TACHO_H

#include <stdbool.h>
#include <stdint.h>

#include "settings.h"

#define EDGES (PULSES + 1) /* of a whole revolution */

typedef struct {
    uint32_t edge_us[EDGES]; /* a ring of the last pulses */
    uint32_t level_since_us; /* since when the pin has its level */
    uint16_t pulses;         /* since the start, wraps */
    uint16_t glitches;       /* levels that were too short, wraps */
    uint8_t newest;          /* place of the last pulse in the ring */
    uint8_t known;           /* pulses in the ring */
    bool level;              /* of the pin */
    bool settled_level;      /* the last one that lasted */
    bool has_stood;          /* it has stood, or turned a whole revolution: 0 is a reading */
} tacho_t;

void tacho_start(tacho_t *tacho, bool level, uint32_t now_us);

/* The pin changed its level. For the interrupt. */
void tacho_edge(tacho_t *tacho, bool level, uint32_t now_us);

/* Take over a level that has lasted, and forget the pulses of a fan that stands: before each reading, at least every
 * hour, with interrupts off. */
void tacho_settle(tacho_t *tacho, uint32_t now_us);

/* The speed of the last whole revolution in rpm; less once the next pulse is half as late again as it should be; 0
 * where it stands; NaN before anything is known. */
float tacho_period_rpm(const tacho_t *tacho, uint32_t now_us);

/* rpm of so many pulses within WINDOW_MS. */
float tacho_count_rpm(uint16_t pulses);

#endif
