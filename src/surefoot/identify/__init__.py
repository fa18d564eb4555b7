"""System identification: experiments, recordings, replay in simulation, and fits of physical parameters."""
