"""Bundle adjustment: windows, whole maps and rigs, with priors, and the covariance of what comes out."""
