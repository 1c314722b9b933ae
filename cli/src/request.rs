//! Requests of the Python package, as data.
//!
//! ```
//! use flotilla_app::ops::Context;
//! use flotilla_cli::request;
//!
//! let request = r#"{"use_case": "verify", "config": ["mine.toml", "[world]"]}"#;
//! let request = serde_json::from_str(request)?;
//! let error = request::answer(&request, &mut &mut flotilla::front::cpu(), Context::new(&|_| ()));
//! assert_eq!(error.unwrap_err().code(), "config_invalid");
//! # Ok::<(), serde_json::Error>(())
//! ```

use flotilla_app::ops::{BackendSource, Context, Error, compare, sweep, verify};
use flotilla_studies::paper;
use serde::Deserialize;

#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "use_case", rename_all = "snake_case")]
pub enum Request {
    Paper(paper::run::Request),
    Sweep(sweep::SweepRequest),
    Compare(compare::CompareRequest),
    Verify(verify::VerifyRequest),
}

/// Runs the use case of a request, and returns its outcome as data.
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
        Request::Sweep(request) => serde_json::to_value(sweep::run(request, backends, context)?),
        Request::Compare(request) => serde_json::to_value(compare::run(request, context)?),
        Request::Verify(request) => serde_json::to_value(verify::run(request, context)?),
    };
    Ok(outcome.expect("outcomes are JSON"))
}
