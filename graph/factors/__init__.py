"""The graph as arrays: observations, relative poses, priors, their checks, and GTSAM factors."""
