"""Linear model-predictive control on OSQP."""
