"""The control loop over a wire: packets, a server that decides, and a plant in real time at its other end."""
