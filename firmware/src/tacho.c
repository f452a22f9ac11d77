#include "tacho.h"

#include <math.h>

#define MINUTE_US 60e6f
#define STANDING_US (STANDING_MS * 1000UL)

void tacho_start(tacho_t *tacho, bool level, uint32_t now_us)
{
    *tacho = (tacho_t){.level = level, .settled_level = level, .level_since_us = now_us};
    tacho->edge_us[0] = now_us;
}

static void settle_level(tacho_t *tacho, uint32_t now_us)
{
    if (tacho->level == tacho->settled_level || now_us - tacho->level_since_us < GLITCH_US)
        return;
    tacho->settled_level = tacho->level;
    if (tacho->level)
        return;
    tacho->newest = tacho->newest + 1 == EDGES ? 0 : tacho->newest + 1;
    tacho->edge_us[tacho->newest] = tacho->level_since_us;
    tacho->pulses++;
    if (tacho->known < EDGES)
        tacho->known++;
}

void tacho_edge(tacho_t *tacho, bool level, uint32_t now_us)
{
    if (level == tacho->level)
        return; /* it was back before the interrupt could look */
    settle_level(tacho, now_us);
    if (level == tacho->settled_level)
        tacho->glitches++;
    tacho->level = level;
    tacho->level_since_us = now_us;
}

void tacho_settle(tacho_t *tacho, uint32_t now_us)
{
    settle_level(tacho, now_us);
    if (tacho->known == EDGES)
        tacho->has_stood = true;
    if (now_us - tacho->edge_us[tacho->newest] > STANDING_US) {
        tacho->known = 0;
        tacho->has_stood = true;
        /* Else it would be a recent pulse again when the clock wraps. */
        tacho->edge_us[tacho->newest] = now_us - STANDING_US - 1;
    }
}

float tacho_period_rpm(const tacho_t *tacho, uint32_t now_us)
{
    if (tacho->known < EDGES)
        return tacho->has_stood ? 0.0f : NAN;
    uint8_t oldest = tacho->newest + 1 == EDGES ? 0 : tacho->newest + 1;
    uint32_t revolution_us = tacho->edge_us[tacho->newest] - tacho->edge_us[oldest];
    uint32_t as_revolution_us = (now_us - tacho->edge_us[tacho->newest]) * PULSES;
    /* Magnets are not set evenly: a pulse that is a little late says nothing. */
    if (as_revolution_us > revolution_us + revolution_us / 2)
        revolution_us = as_revolution_us;
    return MINUTE_US / (float)revolution_us;
}

float tacho_count_rpm(uint16_t pulses)
{
    return (float)pulses * (60e3f / ((float)WINDOW_MS * PULSES));
}
