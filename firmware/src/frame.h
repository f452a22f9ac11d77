/* Frames of the serial protocol, version 1: docs/reference/wire-protocol.md. Sizes are bounded, nothing is allocated. */
#ifndef FRAME_H
#define FRAME_H

#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "settings.h"

#define FRAME_VERSION 1
enum { TYPE_SAMPLE = 1, TYPE_COMMAND = 2, TYPE_SET_POINT = 3, TYPE_SAMPLE_WITH_COLUMNS = 4, TYPE_COUNTERS = 5 };
enum { COLUMN_SUPPLY = 1 };

typedef struct {
    uint32_t clock_us, sequence;
    float command[FANS];
    float speed_rpm[FANS]; /* NaN: no reading */
    float supply_v;
} sample_t;

/* Version, type, clock, sequence, fans, [columns,] values, CRC; a code byte and two delimiters. */
#define SAMPLE_LINE_BYTES (11 + SUPPLY + 4 * FANS * (2 + SUPPLY) + 4 + 3)

/* Write a sample as it goes onto the line; returns its length. */
uint8_t sample_encode(const sample_t *sample, uint8_t line[SAMPLE_LINE_BYTES]);

/* Version, type, uptime, number of counters, counters, CRC; a code byte and two delimiters. */
#define COUNTERS_LINE_BYTES (7 + 2 * COUNTERS + 4 + 3)

/* Write the counters as they go onto the line; returns their length. */
uint8_t counters_encode(uint32_t uptime_s, const uint16_t counts[COUNTERS], uint8_t line[COUNTERS_LINE_BYTES]);

typedef enum {
    RECEIVED_NOTHING, /* the frame is not complete */
    RECEIVED_COMMAND,
    RECEIVED_SET_POINT,
    RECEIVED_BAD_LENGTH, /* longer or shorter than a frame of FANS fans, or broken COBS */
    RECEIVED_BAD_CRC,
    RECEIVED_WRONG_KIND, /* another version, type or number of fans */
    RECEIVED_BAD_VALUE,  /* a value out of range: the whole frame is refused */
} received_t;

#define INPUT_PAYLOAD_BYTES (3 + 4 * FANS)
#define INPUT_PIECE_BYTES (INPUT_PAYLOAD_BYTES + 4 + 1)

typedef struct {
    uint8_t piece[INPUT_PIECE_BYTES];
    uint8_t length;
    bool is_too_long;
} receiver_t;

/* Take one byte of the line. After RECEIVED_COMMAND, values are duties; after RECEIVED_SET_POINT, rpm; NaN: unchanged. */
received_t receiver_take(receiver_t *receiver, uint8_t byte, float values[FANS]);

#endif
