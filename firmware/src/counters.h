/* What went wrong since the start, sent once a second in this order. Each wraps at 65536. */
#ifndef COUNTERS_H
#define COUNTERS_H

#include <stdint.h>

typedef struct {
    uint16_t frames;         /* taken: commands and set-points */
    uint16_t bad_length;     /* pieces that are no frame of FANS fans */
    uint16_t bad_crc;
    uint16_t wrong_kind;     /* version, type or number of fans */
    uint16_t bad_value;      /* out of range */
    uint16_t line_errors;    /* framing, parity: the wrong baud, or noise */
    uint16_t overruns;       /* bytes that came too fast for the interrupt, or for the buffer */
    uint16_t unsent_samples; /* the line was still busy */
    uint16_t lost_edges;     /* of tachos: there were more than the loop could take */
    uint16_t glitches;       /* of all tachos: levels that were too short */
    uint16_t host_silences;
    uint16_t watchdog_resets; /* 1 if the last start was one */
} counters_t;

#define COUNTERS (sizeof(counters_t) / sizeof(uint16_t))

extern volatile counters_t counters;

static inline void count(volatile uint16_t *counter)
{
    ++*counter;
}

#endif
