#include "fan.h"

#include <math.h>

#define DUTY_PER_RPM ((float)(LOOP_DUTY_PER_1000_RPM) / 1000.0f)
#define INTEGRAL_SHARE (1.0f / ((float)(LOOP_TIME_S) * RATE_HZ))

static float within_0_1(float duty)
{
    return duty < 0.0f ? 0.0f : duty > 1.0f ? 1.0f : duty;
}

void fan_start(fan_t *fan)
{
    *fan = (fan_t){.duty = 1.0f};
}

void fan_set_duty(fan_t *fan, float duty)
{
    fan->duty = within_0_1(duty);
    fan->holds_speed = false;
}

void fan_set_speed(fan_t *fan, float set_point_rpm, float speed_rpm)
{
    if (!fan->holds_speed && !isnan(speed_rpm)) /* from the present duty on, without a jump */
        fan->integral = within_0_1(fan->duty - DUTY_PER_RPM * (set_point_rpm - speed_rpm));
    fan->set_point_rpm = set_point_rpm;
    fan->holds_speed = true;
}

void fan_step(fan_t *fan, float speed_rpm)
{
    if (!fan->holds_speed)
        return;
    if (isnan(speed_rpm)) {
        fan->duty = 1.0f;
        return;
    }
    if (fan->set_point_rpm <= 0.0f) {
        fan->duty = fan->integral = 0.0f;
        return;
    }
    float proportional = DUTY_PER_RPM * (fan->set_point_rpm - speed_rpm);
    /* Clamped, so that it does not go on rising while the duty is at its end. */
    fan->integral = within_0_1(fan->integral + proportional * INTEGRAL_SHARE);
    fan->duty = within_0_1(fan->integral + proportional);
}

uint16_t fan_level(const fan_t *fan)
{
    return (uint16_t)(fan->duty * PWM_STEPS + 0.5f);
}

void host_commanded(host_t *host)
{
    host->has_commanded = true;
    host->silent_samples = 0;
}

bool host_falls_silent(host_t *host)
{
    const uint32_t patience = (uint32_t)HOST_SILENCE_S * RATE_HZ;
    if (patience == 0 || !host->has_commanded || ++host->silent_samples < patience)
        return false;
    host->has_commanded = false;
    return true;
}
