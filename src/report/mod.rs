//! Pictures of what was learned, for people.
//!
//! | module | holds |
//! |---|---|
//! | [`scene`] | a picture described once, written as SVG, PDF or PNG |
//! | [`letters`], [`pdf`] | its letters; how it becomes a PDF |
//! | [`map`] | a team on its map: agents, POIs, trails |
//! | [`curves`] | learning curves: mean and standard error over trials, and the figure that shows them |
//! | [`runs`] | what runs' folders say of their curves, and what is wrong with them |
//! | [`comparison`] | arms side by side, with intervals and tests |
//! | [`grid`] | heat maps and curves over the axes of a sweep |
//! | [`paper`] | the paper's experiments, its figures and its claims, one by one |
//! | [`replay`] | episodes of any trial and generation, as a page or a picture |
//! | [`tensorboard`] | event files for TensorBoard |
//! | [`table`] | tables of text, for people and for LaTeX |
//! | [`progress`] | every arm's curve on the terminal while it grows |

pub mod comparison;
pub mod curves;
pub mod grid;
pub mod letters;
pub mod map;
pub mod paper;
pub mod pdf;
#[cfg(feature = "cli")]
pub mod progress;
pub mod replay;
pub mod runs;
pub mod scene;
pub mod table;
pub mod tensorboard;
