"""System identification: a validated teacher, manoeuvres, and the fit of the articulated car to what the teacher did."""
