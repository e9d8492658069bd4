"""How far a closed loop is from instability: predicted from its linear model, and measured in the nonlinear one."""
