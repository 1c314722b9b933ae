//! Structural credit assignment: what each leader was worth to its team, from the record of one episode.
