/* The supply of the fans from two conversions against the same unknown reference. No hardware. */
#ifndef SUPPLY_H
#define SUPPLY_H

#include <stdint.h>

#include "settings.h"

/* V at the fans. pin, bandgap: means (or sums of equally many) of what the converter shows for the divider and for the
 * chip's own reference, both against its supply, which so cancels. NaN without a bandgap. */
float supply_volts(uint16_t pin, uint16_t bandgap);

#endif
