#include "frame.h"

#include <math.h>
#include <string.h>

#include "cobs.h"
#include "crc32.h"

_Static_assert(sizeof(float) == 4, "floats travel as they lie in memory");
_Static_assert(SAMPLE_LINE_BYTES <= COBS_LONGEST, "a sample is one COBS piece");

static uint8_t append(uint8_t *to, uint8_t at, const void *bytes, uint8_t length)
{
    memcpy(to + at, bytes, length);
    return at + length;
}

/* The payload with its CRC, which has room behind it. A delimiter on both sides: noise on an idle line then ends before
 * the frame and cannot spoil it. */
static uint8_t enclose(uint8_t *payload, uint8_t length, uint8_t *line)
{
    uint32_t crc = crc32(payload, length);
    length = append(payload, length, &crc, 4);
    line[0] = 0;
    uint8_t line_length = 1 + cobs_encode(payload, length, line + 1);
    line[line_length++] = 0;
    return line_length;
}

uint8_t sample_encode(const sample_t *sample, uint8_t line[SAMPLE_LINE_BYTES])
{
    uint8_t payload[SAMPLE_LINE_BYTES];
    uint8_t at = 0;
    payload[at++] = FRAME_VERSION;
    payload[at++] = SUPPLY ? TYPE_SAMPLE_WITH_COLUMNS : TYPE_SAMPLE;
    at = append(payload, at, &sample->clock_us, 4);
    at = append(payload, at, &sample->sequence, 4);
    payload[at++] = FANS;
    if (SUPPLY)
        payload[at++] = COLUMN_SUPPLY;
    for (uint8_t fan = 0; fan < FANS; fan++) {
        at = append(payload, at, &sample->command[fan], 4);
        at = append(payload, at, &sample->speed_rpm[fan], 4);
        if (SUPPLY)
            at = append(payload, at, &sample->supply_v, 4);
    }
    return enclose(payload, at, line);
}

uint8_t counters_encode(uint32_t uptime_s, const uint16_t counts[COUNTERS], uint8_t line[COUNTERS_LINE_BYTES])
{
    uint8_t payload[COUNTERS_LINE_BYTES] = {FRAME_VERSION, TYPE_COUNTERS};
    uint8_t at = append(payload, 2, &uptime_s, 4);
    payload[at++] = COUNTERS;
    at = append(payload, at, counts, 2 * COUNTERS);
    return enclose(payload, at, line);
}

static received_t decode(uint8_t *piece, uint8_t piece_length, float values[FANS])
{
    int16_t length = cobs_decode(piece, piece_length);
    if (length < 3 + 4)
        return RECEIVED_BAD_LENGTH;
    uint8_t payload_length = length - 4;
    uint32_t crc;
    memcpy(&crc, piece + payload_length, 4);
    if (crc != crc32(piece, payload_length))
        return RECEIVED_BAD_CRC;
    uint8_t type = piece[1];
    if (piece[0] != FRAME_VERSION || (type != TYPE_COMMAND && type != TYPE_SET_POINT) || piece[2] != FANS)
        return RECEIVED_WRONG_KIND;
    if (payload_length != INPUT_PAYLOAD_BYTES)
        return RECEIVED_BAD_LENGTH;
    memcpy(values, piece + 3, 4 * FANS);
    float largest = type == TYPE_COMMAND ? 1.0f : (float)SPEED_MAX_RPM;
    for (uint8_t fan = 0; fan < FANS; fan++)
        if (!isnan(values[fan]) && !(values[fan] >= 0.0f && values[fan] <= largest))
            return RECEIVED_BAD_VALUE;
    return type == TYPE_COMMAND ? RECEIVED_COMMAND : RECEIVED_SET_POINT;
}

received_t receiver_take(receiver_t *receiver, uint8_t byte, float values[FANS])
{
    if (byte != 0) {
        if (receiver->length < sizeof receiver->piece)
            receiver->piece[receiver->length++] = byte;
        else
            receiver->is_too_long = true;
        return RECEIVED_NOTHING;
    }
    received_t received = RECEIVED_NOTHING;
    if (receiver->is_too_long)
        received = RECEIVED_BAD_LENGTH;
    else if (receiver->length > 0)
        received = decode(receiver->piece, receiver->length, values);
    receiver->length = 0;
    receiver->is_too_long = false;
    return received;
}
