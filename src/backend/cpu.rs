//! The reference backend: many teams per instruction, rayon across blocks of teams.
