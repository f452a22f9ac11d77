/* Consistent overhead byte stuffing of short pieces: a code byte for each zero, no zero left. */
#ifndef COBS_H
#define COBS_H

#include <stdint.h>

#define COBS_LONGEST 253 /* bytes that one code byte can stand for */

/* Encode `length` <= COBS_LONGEST bytes into `length` + 1; returns how many were written. */
uint8_t cobs_encode(const uint8_t *bytes, uint8_t length, uint8_t *out);

/* Decode in place; returns the length, or -1 if the piece ends within a block or holds a zero. */
int16_t cobs_decode(uint8_t *piece, uint8_t length);

#endif
