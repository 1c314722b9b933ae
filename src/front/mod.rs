//! The functions that most programs need: train with a callback, play and trace given policies, and step teams by given
//! actions.
//!
//! All functions check their arguments and return flat arrays. The documentation gives their shapes, for example
//! `[teams][leaders][8]`; the last index changes fastest. The functions build on [`crate::trainer`],
//! [`crate::evaluate`] and [`crate::stepping`]. Training that saves its files as it goes, and can be resumed, is in the
//! package `flotilla-app`.
//!
//! | module | contents |
//! |---|---|
//! | `error` | what all functions return if they fail |
//! | `open` | the processor that plays, and its backend |
//! | `results` | the results of a training |
//! | `coevolution` | the driver of a training, whose caller may score the policies (ask and tell) |
//! | `train` | training with a callback |
//! | `play` | playing, tracing and stepping of given policies |
//! | `score` | scores of given paths |

mod coevolution;
mod error;
mod open;
mod play;
mod results;
mod score;
mod train;

pub use coevolution::{Coevolution, Progress};
pub use error::Failure;
pub use open::cpu;
#[cfg(feature = "gpu")]
pub use open::{Processor, find_gpu, on_gpu, open};
pub use play::{ActionNoise, Played, Traced, play, play_until, record, stepper, trace, with_team};
pub use results::{Generation, Trained};
pub use score::{Scored, score};
pub use train::{train, train_from, train_with_champions};
