#include "supply.h"

#include <math.h>

#define VOLTS_OF_BANDGAP ((float)BANDGAP_MV / 1000.0f)
#define DIVIDER (((float)DIVIDER_HIGH_OHM + (float)DIVIDER_LOW_OHM) / (float)DIVIDER_LOW_OHM)

float supply_volts(uint16_t pin, uint16_t bandgap)
{
    return bandgap == 0 ? NAN : (float)pin / (float)bandgap * (VOLTS_OF_BANDGAP * DIVIDER);
}
