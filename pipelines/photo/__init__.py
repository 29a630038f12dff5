"""One photograph or video of one camera without calibration, made ready for the stages."""
