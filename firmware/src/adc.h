/* The analog converter: supply of the fans on ADC4, and the chip's own reference beside it. */
#ifndef ADC_H
#define ADC_H

void adc_start(void);

/* Take what has been converted and start the next: once a millisecond, never waits. */
void adc_step(void);

/* V at the fans over the last round of conversions; NaN before the first. */
float adc_supply_v(void);

#endif
