//! Finding, opening and using a GPU.
//!
//! [`super::open`] also tests a device.
//!
//! | file | holds |
//! |---|---|
//! | `adapter` | adapters: finding them, describing them, choosing one |
//! | `error` | why a GPU could not be opened, or failed |
//! | `waiting` | waiting for a device, which may never answer |
//! | `executor` | buffers, pipelines, and carrying recordings out |

use std::collections::HashMap;
use std::fmt;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use wgpu::util::DeviceExt;

use super::exact::Pass;
use super::faults::Faults;
use super::source::Pipeline;
use crate::host;
use crate::parallel::lock;

mod adapter;
mod error;
mod executor;
mod waiting;

pub(super) use adapter::choose;
pub use adapter::{AdapterChoice, AdapterInfo, Kind, Request, adapters, compiler, position};
pub use error::DeviceError;
pub use executor::{Executor, Traffic, Workspace};
pub use waiting::{WaitLimit, report_stalls};

use error::chain;

/// Errors since the device was opened, from wgpu's callbacks.
#[derive(Default)]
struct DeviceErrors {
    lost: Option<String>,
    error: Option<String>,
}

/// An opened device whose arithmetic was tested under `pass`. Clones share the device.
#[derive(Clone)]
pub struct Gpu {
    /// The adapter.
    pub adapter: AdapterInfo,
    /// The device's limits.
    pub limits: wgpu::Limits,
    /// The compile pass of its shaders.
    pub pass: Pass,
    /// Whether shaders keep their checks, see [`Request::checked`].
    pub checked: bool,
    /// The wgpu device.
    pub device: wgpu::Device,
    /// The only queue.
    pub queue: wgpu::Queue,
    /// A buffer of zeros that guarded arithmetic uses: binding 0 of every bind group.
    guard: wgpu::Buffer,
    errors: Arc<Mutex<DeviceErrors>>,
    /// Bytes to and from the device.
    traffic: Arc<[AtomicU64; 2]>,
    /// The next nonce, see [`Gpu::nonces`].
    nonce: Arc<AtomicU32>,
    wait_limit: WaitLimit,
    /// Pipelines that the self-test has compiled.
    tested: Arc<HashMap<Pipeline, wgpu::ComputePipeline>>,
    /// Faults that tests inject.
    #[cfg(debug_assertions)]
    faults: Option<Arc<dyn Faults>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Gpu").field("adapter", &self.adapter).field("pass", &self.pass).finish_non_exhaustive()
    }
}

impl Gpu {
    /// Opens an adapter, without testing it.
    pub(super) fn new(
        adapter: &wgpu::Adapter,
        info: AdapterInfo,
        pass: Pass,
        limits: wgpu::Limits,
        features: wgpu::Features,
        checked: bool,
    ) -> Result<Gpu, DeviceError> {
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("flotilla"),
            required_features: features,
            required_limits: limits.clone(),
            ..Default::default()
        };
        let refused = |error: wgpu::RequestDeviceError| DeviceError::Refused {
            adapter: info.to_string(),
            reason: error.to_string(),
        };
        let (device, queue) = host::wait(adapter.request_device(&descriptor)).map_err(refused)?;
        let errors = Arc::new(Mutex::new(DeviceErrors::default()));
        let noted = errors.clone();
        device.set_device_lost_callback(move |reason, message| {
            let reason = if message.is_empty() { format!("{reason:?}") } else { message };
            lock(&noted).lost.get_or_insert(reason);
        });
        let noted = errors.clone();
        device.on_uncaptured_error(Arc::new(move |error| {
            lock(&noted).error.get_or_insert(chain(&error));
        }));
        let guard = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("guard"),
            contents: &[0; 16],
            usage: wgpu::BufferUsages::UNIFORM,
        });
        // Another value in each process, because memory may keep nonces of a process before.
        let nonce = Arc::new(AtomicU32::new(host::since_1970().as_nanos() as u32));
        let wait_limit = if info.kind == Kind::Software { WaitLimit::WITH_SOFTWARE } else { WaitLimit::WITH_GPUS };
        Ok(Gpu {
            adapter: info,
            limits,
            pass,
            checked,
            device,
            queue,
            guard,
            errors,
            traffic: Arc::default(),
            nonce,
            wait_limit,
            tested: Arc::default(),
            #[cfg(debug_assertions)]
            faults: None,
        })
    }

    /// Returns the device with the pipelines of its self-test.
    pub(super) fn with_tested(self, tested: HashMap<Pipeline, wgpu::ComputePipeline>) -> Gpu {
        Gpu { tested: Arc::new(tested), ..self }
    }

    /// Injects faults, so that tests can show that each is noticed.
    ///
    /// # Safety
    /// Shaders are compiled without bounds checks. An edited shader must keep its indices in bounds and its loops
    /// finite, see [`Gpu::pipeline`].
    #[cfg(debug_assertions)]
    #[doc(hidden)]
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    pub unsafe fn failing(self, faults: Arc<dyn Faults>) -> Gpu {
        Gpu { faults: Some(faults), ..self.with_tested(HashMap::new()) }
    }

    /// Returns the faults that a test injects. Release builds have none.
    #[cfg(debug_assertions)]
    pub(super) fn faults(&self) -> Option<&dyn Faults> {
        self.faults.as_deref()
    }

    #[cfg(not(debug_assertions))]
    pub(super) fn faults(&self) -> Option<&dyn Faults> {
        None
    }

    /// Takes `count` consecutive numbers that no other work of this device has, and returns the first.
    ///
    /// Work writes its nonce beside its results, so that results of earlier work are never taken for its own: some
    /// drivers report work as done that a watchdog ended, and leave the old bytes.
    pub(super) fn nonces(&self, count: u32) -> u32 {
        self.nonce.fetch_add(count, Relaxed)
    }

    /// Records that the device was lost, so that every later call fails, and returns that error.
    pub(super) fn lose(&self, reason: &str) -> DeviceError {
        let mut errors = lock(&self.errors);
        let reason = errors.lost.get_or_insert_with(|| reason.into()).clone();
        DeviceError::Lost { adapter: self.adapter.to_string(), reason }
    }

    /// Records that a status word is missing, and returns the error.
    fn lose_undone(&self) -> DeviceError {
        self.lose("the driver reports work as done, but the device did not do it; a watchdog may have ended it")
    }

    /// Returns an error if the device was lost, or if anything failed outside of [`Gpu::scoped`]. Call it after every
    /// wait.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub fn check(&self) -> Result<(), DeviceError> {
        let mut errors = lock(&self.errors);
        if let Some(reason) = &errors.lost {
            return Err(DeviceError::Lost { adapter: self.adapter.to_string(), reason: reason.clone() });
        }
        match errors.error.take() {
            Some(reason) => Err(self.failed("a command", reason)),
            None => Ok(()),
        }
    }

    fn failed(&self, what: &str, reason: impl ToString) -> DeviceError {
        DeviceError::Failed { adapter: self.adapter.to_string(), what: what.into(), reason: reason.to_string() }
    }

    /// Runs `make`, and returns any error of wgpu as an error about `what`.
    ///
    /// # Errors
    /// wgpu reported an error, or the device was lost.
    pub fn scoped<T>(&self, what: &str, make: impl FnOnce() -> T) -> Result<T, DeviceError> {
        use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
        let [memory, validation, internal] =
            [OutOfMemory, Validation, Internal].map(|f| self.device.push_error_scope(f));
        let made = make();
        // Scopes have to be popped innermost first.
        let errors = [host::wait(internal.pop()), host::wait(validation.pop()), host::wait(memory.pop())];
        self.check()?;
        match errors.into_iter().flatten().next() {
            None => Ok(made),
            Some(wgpu::Error::OutOfMemory { .. }) => {
                Err(DeviceError::OutOfMemory { adapter: self.adapter.to_string(), what: what.into() })
            }
            Some(error) => Err(self.failed(what, chain(&error))),
        }
    }
}
