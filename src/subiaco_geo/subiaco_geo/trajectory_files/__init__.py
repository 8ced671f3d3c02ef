"""Trajectories that other systems computed: SBET, RTKLIB, named columns, TUM."""
