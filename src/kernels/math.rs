//! The exact core.
