//! Pictures, films, pages and comparisons of runs.
//!
//! | module | contents |
//! |---|---|
//! | [`scene`] | a picture described once, written as SVG, PDF or PNG |
//! | [`letters`], [`pdf`] | its text as outlines; its PDF form |
//! | [`map`] | a team on its map: agents, POIs, trails |
//! | [`curves`] | learning curves: mean and standard error over trials, and their figure |
//! | [`runs`] | reading the curves of run directories, with errors |
//! | [`comparison`] | comparison of arms, with intervals and tests |
//! | [`grid`] | heat maps and curves over the axes of a sweep |
//! | [`replay`] | episodes of any trial and generation, as a page or a picture |
//! | [`table`] | text tables, for people and for LaTeX |

pub mod comparison;
pub mod curves;
pub mod grid;
pub mod letters;
pub mod map;
pub mod pdf;
pub mod replay;
pub mod runs;
pub mod scene;
pub mod table;
