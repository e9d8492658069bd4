/* The functions that CasADi has written: arg and res point to inputs and outputs, iw and w are memory to work in. */
#ifndef PCR_GRAPHS_H
#define PCR_GRAPHS_H

#ifdef __cplusplus
extern "C" {
#endif

int pcr_graph_foresight(const double **arg, double **res, int *iw, double *w);
int pcr_graph_check(const double **arg, double **res, int *iw, double *w);
int pcr_graph_follow(const double **arg, double **res, int *iw, double *w);
int pcr_graph_finish(const double **arg, double **res, int *iw, double *w);
int pcr_graph_target_follow(const double **arg, double **res, int *iw, double *w);
int pcr_graph_target_finish(const double **arg, double **res, int *iw, double *w);
int pcr_graph_watch_follow(const double **arg, double **res, int *iw, double *w);
int pcr_graph_watch_finish(const double **arg, double **res, int *iw, double *w);
int pcr_graph_strain_nodes(const double **arg, double **res, int *iw, double *w);
int pcr_graph_strain_along(const double **arg, double **res, int *iw, double *w);
int pcr_graph_strain_there(const double **arg, double **res, int *iw, double *w);
int pcr_graph_plant_once(const double **arg, double **res, int *iw, double *w);
int pcr_graph_plant_twice(const double **arg, double **res, int *iw, double *w);
int pcr_graph_determinant(const double **arg, double **res, int *iw, double *w);
int pcr_graph_curvature(const double **arg, double **res, int *iw, double *w);

#ifdef __cplusplus
}
#endif

#endif
