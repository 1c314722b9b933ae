//! Policies, metrics and the run folder.
