"""Linear model-predictive control on OSQP or DAQP."""
