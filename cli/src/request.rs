//! All use cases of the program as data, from any source.
//!
//! ```
//! use flotilla_app::ops::Context;
//! use flotilla_cli::request;
//!
//! let request = r#"{"use_case": "check", "name": "mine", "config": {"text": "[world]", "name": "mine.toml"}}"#;
//! let request = serde_json::from_str(request)?;
//! let error = request::answer(&request, &mut &mut flotilla::front::cpu(), Context::new(&|_| ()));
//! assert_eq!(error.unwrap_err().code(), "config_invalid");
//! # Ok::<(), serde_json::Error>(())
//! ```

use flotilla_app::ops::{
    BackendSource, Context, Error, baseline, check, compare, plot, replay, rollout, sweep, train, verify,
};
use flotilla_studies::{paper, questions, tasks};
use serde::Deserialize;

/// A request as data.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "use_case", rename_all = "snake_case")]
pub enum Request {
    /// See [`paper`].
    Paper(paper::run::Request),
    /// See [`questions`].
    Questions(paper::run::Request),
    /// See [`sweep`].
    Sweep(sweep::SweepRequest),
    /// See [`compare`].
    Compare(compare::CompareRequest),
    /// See [`verify`].
    Verify(verify::VerifyRequest),
    /// See [`train`].
    Train(train::TrainRequest),
    /// See [`check`].
    Check(check::CheckRequest),
    /// See [`rollout`].
    Rollout(rollout::RolloutRequest),
    /// See [`replay`].
    Replay(replay::ReplayRequest),
    /// See [`plot`].
    Plot(plot::PlotRequest),
    /// See [`baseline`].
    Baseline(baseline::BaselineRequest),
    /// See [`tasks`].
    Tasks(tasks::Request),
}

/// Runs any use case, and returns its outcome as data.
///
/// # Errors
/// Those of the use case. A sweep with missing points, and a comparison with the CPU that finds a difference, are
/// outcomes.
pub fn answer(
    request: &Request,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<serde_json::Value, Error> {
    let outcome = match request {
        Request::Paper(request) => serde_json::to_value(paper::run::run(request, backends, context)?),
        Request::Questions(request) => serde_json::to_value(questions::run::run(request, backends, context)?),
        Request::Sweep(request) => serde_json::to_value(sweep::run(request, backends, context)?),
        Request::Compare(request) => serde_json::to_value(compare::run(request, context)?),
        Request::Verify(request) => serde_json::to_value(verify::run(request, context)?),
        Request::Train(request) => serde_json::to_value(train::run(request, backends, context)?),
        Request::Check(request) => serde_json::to_value(check::run(request, context)?),
        Request::Rollout(request) => serde_json::to_value(rollout::run(request, backends, context)?),
        Request::Replay(request) => serde_json::to_value(replay::run(request, backends, context)?),
        Request::Plot(request) => serde_json::to_value(plot::run(request, context)?),
        Request::Baseline(request) => serde_json::to_value(baseline::run(request, backends, context)?),
        Request::Tasks(request) => serde_json::to_value(tasks::run(request, backends, context)?),
    };
    Ok(outcome.expect("outcomes are JSON"))
}
