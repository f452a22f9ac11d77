#ifdef __AVR__
#include "adc.h"

#include <avr/io.h>
#include <math.h>

#include "supply.h"

/* A round: the divider, then the reference. The first two of each are not used: the reference takes a millisecond to
 * settle behind the multiplexer. */
#define UNUSED 2
#define USED 6
#define PIN (_BV(REFS0) | 4)      /* ADC4 against the supply of the chip */
#define BANDGAP (_BV(REFS0) | 14) /* 1.1 V against it */

static uint16_t pin_sum, bandgap_sum;
static uint8_t conversions;
static float supply_v = NAN;

void adc_start(void)
{
    DIDR0 = _BV(ADC4D);
    ADMUX = PIN;
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0); /* 125 kHz: 104 us a conversion */
}

void adc_step(void)
{
    if (ADCSRA & _BV(ADSC))
        return;
    uint16_t value = ADC;
    uint8_t of_half = conversions % (UNUSED + USED);
    if (of_half >= UNUSED) {
        if (conversions < UNUSED + USED)
            pin_sum += value;
        else
            bandgap_sum += value;
    }
    conversions++;
    if (conversions == UNUSED + USED)
        ADMUX = BANDGAP;
    if (conversions == 2 * (UNUSED + USED)) {
        supply_v = supply_volts(pin_sum, bandgap_sum);
        pin_sum = bandgap_sum = conversions = 0;
        ADMUX = PIN;
    }
    ADCSRA |= _BV(ADSC);
}

float adc_supply_v(void)
{
    return supply_v;
}
#endif
