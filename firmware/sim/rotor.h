/* A fan's rotor by the equation of motion of simulation/plant.py, with a tacho of two pulses a revolution.
 *
 *     J w' + alpha w + C_D w|w| = i - friction(w),    lag i' + i = supply * drive(duty)       torques in volts */
#ifndef ROTOR_H
#define ROTOR_H

#include <stdbool.h>

#define ROTOR_EDGES 4 /* of the tacho's level, a revolution */

typedef struct {
    double inertia, viscous, drag; /* V s^2/rad, V s/rad, V s^2/rad^2 */
    double unevenness;             /* of the magnets: share of a revolution by which the second pulse comes late */
} rotor_parameters_t;

typedef struct {
    rotor_parameters_t parameters;
    double speed_rad_s, current_v, turned; /* turned: revolutions, 0 to 1 */
    double drag_factor;
    double held_rad_s; /* turned from outside at this speed; negative: free */
    bool is_blocked;
} rotor_t;

/* One of the four fans of the board, at rest. */
rotor_t rotor_at_rest(int fan);

/* Turn for duration_s <= 1 ms; edges: when the level of the tacho changes, as shares of the step, and to what; returns
 * how many changes there are, at most ROTOR_EDGES. */
int rotor_turn(rotor_t *rotor, double duty, double supply_v, double duration_s, double edges[ROTOR_EDGES],
               bool levels[ROTOR_EDGES]);

/* The level of the tacho now. */
bool rotor_level(const rotor_t *rotor);

#endif
