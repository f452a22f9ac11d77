/* What a fan is to do: a duty or a speed, and who says so. No hardware. */
#ifndef FAN_H
#define FAN_H

#include <stdbool.h>
#include <stdint.h>

#include "settings.h"

#define PWM_STEPS 640 /* of a duty from 0 to 1: 16 MHz / 25 kHz */

typedef struct {
    float duty;          /* 0 to 1 */
    float set_point_rpm; /* where holds_speed */
    float integral;      /* of the speed loop, a duty */
    bool holds_speed;
} fan_t;

/* Full speed, until somebody says otherwise. */
void fan_start(fan_t *fan);
void fan_set_duty(fan_t *fan, float duty);
void fan_set_speed(fan_t *fan, float set_point_rpm, float speed_rpm);

/* One step of the speed loop, RATE_HZ times a second; speed NaN: no reading, full speed. */
void fan_step(fan_t *fan, float speed_rpm);

/* The duty in steps of PWM_STEPS. */
uint16_t fan_level(const fan_t *fan);

/* The host: full speed if it has commanded and is then silent for HOST_SILENCE_S. */
typedef struct {
    uint32_t silent_samples;
    bool has_commanded;
} host_t;

void host_commanded(host_t *host);

/* Once a sample; true at the one at which the silence has become too long. */
bool host_falls_silent(host_t *host);

#endif
