#include "rotor.h"

#include <math.h>

static const double LAG_S = 0.012, COULOMB_V = 0.08, BREAKAWAY_V = 0.25, STRIBECK_RAD_S = 6.0;
static const double DUTY_DEAD = 0.02, DUTY_FULL = 0.99;
static const double BLOCK_S = 0.03, STOPPED_BY_BLOCK_RAD_S = 6.0;

/* The published fan (simulation/plant.py), four of a kind. */
static const rotor_parameters_t OF_THE_BOARD[] = {
    {0.0148, 0.0074, 5.477e-6, 0.004},
    {0.0144, 0.0076, 5.59e-6, 0.010},
    {0.0153, 0.0073, 5.36e-6, 0.000},
    {0.0149, 0.0075, 5.65e-6, 0.015},
};

rotor_t rotor_at_rest(int fan)
{
    return (rotor_t){.parameters = OF_THE_BOARD[fan], .turned = 0.1, .drag_factor = 1.0, .held_rad_s = -1.0};
}

static double drive(double duty)
{
    return fmin(fmax((duty - DUTY_DEAD) / (DUTY_FULL - DUTY_DEAD), 0.0), 1.0);
}

/* The speed at the end of a step: a midpoint step, then friction, which stops but never reverses. */
static double next_speed(rotor_t *rotor, double target_v, double duration_s)
{
    const rotor_parameters_t *p = &rotor->parameters;
    double speed = rotor->speed_rad_s, excess_v = rotor->current_v - target_v, decay = exp(-duration_s / LAG_S);
    double torque_v = target_v + excess_v * (1.0 - decay) * LAG_S / duration_s;
    rotor->current_v = target_v + excess_v * decay;
    if (rotor->held_rad_s >= 0.0)
        return rotor->held_rad_s;
    if (rotor->is_blocked) {
        double braked = speed * exp(-duration_s / BLOCK_S);
        return braked < STOPPED_BY_BLOCK_RAD_S ? 0.0 : braked;
    }
    double drag = p->drag * rotor->drag_factor, per_inertia = duration_s / p->inertia;
    double half = speed + 0.5 * per_inertia * (torque_v - (p->viscous + drag * fabs(speed)) * speed);
    double free = speed + per_inertia * (torque_v - (p->viscous + drag * fabs(half)) * half);
    double rise = exp(-(speed / STRIBECK_RAD_S) * (speed / STRIBECK_RAD_S));
    double impulse = per_inertia * (COULOMB_V + (BREAKAWAY_V - COULOMB_V) * rise);
    return copysign(fmax(fabs(free) - impulse, 0.0), free);
}

static void phases(const rotor_t *rotor, double at[ROTOR_EDGES])
{
    double late = rotor->parameters.unevenness;
    at[0] = 0.0, at[1] = 0.25, at[2] = 0.5 + late, at[3] = 0.75 + late;
}

bool rotor_level(const rotor_t *rotor)
{
    double at[ROTOR_EDGES];
    phases(rotor, at);
    return !(rotor->turned < at[1] || (rotor->turned >= at[2] && rotor->turned < at[3]));
}

int rotor_turn(rotor_t *rotor, double duty, double supply_v, double duration_s, double edges[ROTOR_EDGES],
               bool levels[ROTOR_EDGES])
{
    double before = rotor->speed_rad_s;
    rotor->speed_rad_s = next_speed(rotor, supply_v * drive(duty), duration_s);
    double step = 0.5 * (before + rotor->speed_rad_s) * duration_s / (2.0 * M_PI), end = rotor->turned + step;
    double at[ROTOR_EDGES];
    phases(rotor, at);
    int found = 0;
    for (int turn = 0; turn < 2; turn++)
        for (int i = 0; i < ROTOR_EDGES; i++) {
            double edge = at[i] + turn;
            if (edge <= rotor->turned || edge > end || found == ROTOR_EDGES)
                continue;
            edges[found] = (edge - rotor->turned) / step;
            levels[found++] = i % 2; /* low from the first and third edge on */
        }
    rotor->turned = end - floor(end);
    return found;
}
