"""What a control step is made of: the gate, the start pose, models along the plan, the motors' target."""
