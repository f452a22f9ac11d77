#include "cobs.h"

uint8_t cobs_encode(const uint8_t *bytes, uint8_t length, uint8_t *out)
{
    uint8_t code_at = 0, to = 1;
    for (uint8_t from = 0; from < length; from++) {
        if (bytes[from] == 0) {
            out[code_at] = to - code_at;
            code_at = to++;
        } else {
            out[to++] = bytes[from];
        }
    }
    out[code_at] = to - code_at;
    return to;
}

int16_t cobs_decode(uint8_t *piece, uint8_t length)
{
    uint8_t from = 0, to = 0;
    while (from < length) {
        uint8_t code = piece[from++];
        if (code == 0 || code - 1 > length - from)
            return -1;
        for (uint8_t i = 1; i < code; i++) {
            if (piece[from] == 0)
                return -1;
            piece[to++] = piece[from++];
        }
        if (code != 0xFF && from < length)
            piece[to++] = 0;
    }
    return to;
}
