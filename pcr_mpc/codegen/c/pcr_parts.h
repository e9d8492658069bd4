/* What the files of the runtime share. */
#ifndef PCR_PARTS_H
#define PCR_PARTS_H

#include "pcr.h"
#include "pcr_tables.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Parts of a record of the rods' pose, whose rods have so many unknowns each; what a warm start needs comes first. */
#define PCR_UNKNOWNS 0
#define PCR_TANGENTS(width) ((width) * PCR_N)
#define PCR_POSES(width) (4 * (width) * PCR_N)
#define PCR_LOADS(width) ((4 * (width) + 3) * PCR_N)
#define PCR_LOAD_TANGENTS(width) ((4 * (width) + 6) * PCR_N)
#define PCR_RECORD_OF(width) ((4 * (width) + 20) * PCR_N)
#define PCR_RESULT (6 + 2 * PCR_N)  /* F, K, G */

/* pcr_motors.c: rates nearest to u that keep all limits of the motors now and ever after. `reckoned` is another
   opinion about the angles q, or NULL. */
void pcr_kept(const pcr_controller *controller, const double *u, const double *previous, const double *q,
              const double *reckoned, double *kept);
void pcr_slowed(const pcr_controller *controller, const double *u, double *slowed);
double pcr_clear_way(const pcr_parameters *parameters);
int pcr_met(const pcr_controller *controller, const double *u, const double *previous);

/* pcr_gate.c: what of a measurement is believed; the rest is as expected. */
void pcr_gate_start(pcr_controller *controller, const double *q);
pcr_result pcr_believe(pcr_controller *controller, const pcr_measurement *measured, int *doubts);

/* pcr_past.c: estimates of the last periods, where tips are late. Where the tip was when the picture was taken; what a
   change of [p, v, force] at that time comes to now; and the estimate [x, force] of a period, with its linear model. */
void pcr_past_clear(pcr_controller *controller);
void pcr_past_tip(const pcr_controller *controller, const double *now, double *tip);
void pcr_past_correct(pcr_controller *controller, double *change);
void pcr_past_remember(pcr_controller *controller, const double *corrected, const double *model);

/* pcr_drive.c: rates of the clamps at the angles q in a step of the plant, for commanded rates u. */
void pcr_drive_start(pcr_drive *drive, const double *q);
void pcr_drive_turn(pcr_drive *drive, const double *numbers, const double *q, const double *u, double *rates);

/* pcr_rods.c: follow the rods from `record` to another pose. Returns 0 if they followed: `record` and `result` are then
   of that pose. `derivatives` is the residual at which derivatives may be taken. */
typedef int pcr_graph(const double **arg, double **res, int *iw, double *w);
typedef struct {
    const double **arg;
    double **res;
    int *iw;
    double *w;
} pcr_room;
typedef struct {
    pcr_graph *twice, *once; /* take two Newton iterations or one */
    int width;               /* unknowns of a rod */
    double following;        /* residual that will do */
} pcr_rods;
pcr_room pcr_room_of(pcr_controller *controller);
extern const pcr_rods pcr_model_rods, pcr_target_rods, pcr_watch_rods;
int pcr_follow(const pcr_rods *rods, const double *numbers, const double *p, const double *q, double derivatives,
               double *record, double *result, const pcr_room *room);

/* pcr_pose.c: limits of the pose ahead that are near. Returns 0 if the rods could follow to it. */
int pcr_near(pcr_controller *controller, pcr_pose_limits *limits);

/* pcr_foreseen.c: evaluate what inputs lead to, where the problem, or models and x alone, lie in check_in; states of the
   plan that stands in `inputs`; by how much predicted states exceed the limits of poses, or `angles` those of the
   motors. */
void pcr_check(pcr_controller *controller);
void pcr_predict_states(pcr_controller *controller, const double *models, const double *x);
double pcr_broken_by(const pcr_controller *controller, const pcr_pose_limits *limits, double angles);

/* pcr_law.c: the plan of the linear MPC, from what `out` of the graph holds; pcr_ladder.c: what is below it. */
void pcr_law_reset(pcr_controller *controller);
void pcr_law_restore(pcr_controller *controller, const pcr_controller *saved);
void pcr_decide(pcr_controller *controller, const pcr_pose_limits *limits, pcr_output *output);
void pcr_fall_back(pcr_controller *controller, const double *x, const double *wanted, const double *inputs,
                   pcr_output *output);

#ifdef __cplusplus
}
#endif

#endif
