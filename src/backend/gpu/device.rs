//! Finding, opening and using a GPU.
//!
//! [`super::open`] also tests a device.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use bytemuck::Pod;
use futures_channel::oneshot;
use wgpu::util::DeviceExt;

use super::absent;
use super::exact::{self, Pass, ShaderError};
use super::faults::Faults;
use crate::escape;
use crate::host::{self, Instant};

/// Names of renderers that run on the CPU, for drivers whose device type hides that.
const SOFTWARE: [&str; 5] = ["llvmpipe", "lavapipe", "swiftshader", "microsoft basic render", "software"];

/// An adapter: a GPU, or a renderer on the CPU.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// The driver's name for the device.
    pub name: String,
    /// The driver and its version. Empty if the backend does not report them.
    pub driver: String,
    /// "vulkan", "metal", "dx12".
    pub backend: String,
    /// The kind of device.
    pub kind: Kind,
}

/// The kind of device, the preferred kinds first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A GPU with memory of its own.
    Discrete,
    /// A GPU that shares the host's memory.
    Integrated,
    /// A GPU passed to a virtual machine.
    Virtual,
    /// The driver does not report the kind.
    Unknown,
    /// A renderer that runs on the CPU.
    Software,
}

impl Kind {
    /// Reports whether this is certainly a GPU.
    pub fn is_real(self) -> bool {
        self <= Kind::Virtual
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Kind::Discrete => "discrete GPU",
            Kind::Integrated => "integrated GPU",
            Kind::Virtual => "virtual GPU",
            Kind::Unknown => "unknown kind",
            Kind::Software => "software renderer",
        })
    }
}

impl fmt::Display for AdapterInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {}", self.name, self.kind, self.backend)?;
        if !self.driver.is_empty() {
            write!(f, ", {}", self.driver)?;
        }
        f.write_str(")")
    }
}

impl From<&wgpu::AdapterInfo> for AdapterInfo {
    fn from(info: &wgpu::AdapterInfo) -> Self {
        let name = info.name.to_lowercase();
        let kind = match info.device_type {
            wgpu::DeviceType::Cpu => Kind::Software,
            _ if SOFTWARE.iter().any(|software| name.contains(software)) => Kind::Software,
            wgpu::DeviceType::DiscreteGpu => Kind::Discrete,
            wgpu::DeviceType::IntegratedGpu => Kind::Integrated,
            wgpu::DeviceType::VirtualGpu => Kind::Virtual,
            wgpu::DeviceType::Other => Kind::Unknown,
        };
        let driver = [info.driver.as_str(), info.driver_info.as_str()];
        AdapterInfo {
            name: escape::line(&info.name).into(),
            driver: escape::line(&driver.iter().filter(|part| !part.is_empty()).copied().collect::<Vec<_>>().join(" "))
                .into(),
            backend: info.backend.to_str().to_string(),
            kind,
        }
    }
}

/// Why a GPU could not be opened, or failed.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// There is no adapter.
    #[error("no GPU adapter found: {}", absent::reasons())]
    NoAdapter,
    /// There are only software renderers, which are opened only by name or number.
    #[error("no GPU among the adapters, only {}{}", list(.found), absent::hints())]
    NoRealAdapter {
        /// The adapters.
        found: Vec<AdapterInfo>,
    },
    /// No adapter has this name or number.
    #[error("no adapter {} \"{name}\"; {}", if is_index(name) { "has the number" } else { "matches" }, there_are(.found))]
    UnknownAdapter {
        /// The name or number.
        name: String,
        /// The adapters.
        found: Vec<AdapterInfo>,
    },
    /// The driver refuses to open it.
    #[error("{adapter}: cannot be opened: {reason}")]
    Refused {
        /// The adapter, with its driver.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// The device's arithmetic differs from the CPU's under every pass.
    #[error("{adapter}: not bit-exact, so it cannot be used: {}", inexact(.failures))]
    Inexact {
        /// The adapter, with its driver.
        adapter: String,
        /// Per pass, the first difference.
        failures: Vec<(Pass, String)>,
    },
    /// The driver lost the device, and everything on it.
    #[error("{adapter}: the device was lost ({reason})")]
    Lost {
        /// The adapter, with its driver.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// The device has too little memory for a buffer.
    #[error("{adapter}: out of memory for {what}; use a smaller batch")]
    OutOfMemory {
        /// The adapter, with its driver.
        adapter: String,
        /// The use of the buffer.
        what: String,
    },
    /// A buffer or binding exceeds the device's limit.
    #[error("{adapter}: {what} needs {bytes} bytes, the device allows {allowed}; use a smaller batch")]
    TooLarge {
        /// The adapter, with its driver.
        adapter: String,
        /// The use of the buffer.
        what: String,
        /// Bytes needed.
        bytes: u64,
        /// Bytes allowed.
        allowed: u64,
    },
    /// A shader does not compile for the device.
    #[error("shader {label} {source}")]
    Shader {
        /// The shader's name.
        label: String,
        /// The error.
        source: ShaderError,
    },
    /// Any other error of wgpu.
    #[error("{adapter}: {what} failed: {reason}")]
    Failed {
        /// The adapter, with its driver.
        adapter: String,
        /// The operation.
        what: String,
        /// The driver's message.
        reason: String,
    },
}

fn list(found: &[AdapterInfo]) -> String {
    found.iter().enumerate().map(|(index, info)| format!("{index}: {info}")).collect::<Vec<_>>().join(", ")
}

/// Reports whether this can only be an adapter's index: a number, even one out of range.
fn is_index(name: &str) -> bool {
    let digits = name.trim().trim_start_matches(['+', '-']);
    !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())
}

fn there_are(found: &[AdapterInfo]) -> String {
    let one = |(index, info): (usize, &AdapterInfo)| format!("{index} ({info})");
    let all: Vec<_> = found.iter().enumerate().map(one).collect();
    match all.len() {
        0 => "there is none at all".into(),
        1 => format!("the only adapter is {}", all[0]),
        _ => format!("the adapters are {}", all.join(", ")),
    }
}

fn inexact(failures: &[(Pass, String)]) -> String {
    failures.iter().map(|(pass, failure)| format!("under the {pass} pass, {failure}")).collect::<Vec<_>>().join("; ")
}

/// Returns all adapters that can compute, the preferred ones first.
///
/// `WGPU_BACKEND` limits the backends (`vulkan`, `metal`, `dx12`). wgpu's other variables have their effect, too, such as
/// `WGPU_DX12_COMPILER`. The Vulkan loader has its own `VK_DRIVER_FILES`.
pub fn adapters() -> Vec<AdapterInfo> {
    found().into_iter().map(|(_, info)| info).collect()
}

fn found() -> Vec<(wgpu::Adapter, AdapterInfo)> {
    // The default instance ignores the environment, and enables validation layers in debug builds.
    let backends = wgpu::Backends::all().with_env();
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        flags: wgpu::InstanceFlags::empty().with_env(),
        backend_options: wgpu::BackendOptions::from_env_or_default(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let mut adapters: Vec<_> = host::wait(instance.enumerate_adapters(backends))
        .into_iter()
        .filter(|a| a.get_downlevel_capabilities().flags.contains(wgpu::DownlevelFlags::COMPUTE_SHADERS))
        .map(|adapter| (adapter.get_info(), adapter))
        .collect();
    // A device that two backends offer is one adapter. The backend that needs no guards wins.
    adapters.sort_by_key(|(info, _)| (AdapterInfo::from(info).kind, info.backend != wgpu::Backend::Vulkan));
    let same = |a: &wgpu::AdapterInfo, b: &wgpu::AdapterInfo| {
        a.backend != b.backend && (a.vendor, a.device, &a.name) == (b.vendor, b.device, &b.name)
    };
    let infos: Vec<_> = adapters.iter().map(|(info, _)| info.clone()).collect();
    let first = |index: usize| !infos[..index].iter().any(|earlier| same(earlier, &infos[index]));
    let kept = adapters.into_iter().enumerate().filter(|(index, _)| first(*index));
    kept.map(|(_, (info, adapter))| (adapter, AdapterInfo::from(&info))).collect()
}

/// Describes the compiler that a backend ("vulkan", "metal", "dx12") passes shaders to.
pub fn compiler(backend: &str) -> String {
    match backend {
        "metal" => "Metal's compiler with fast math, which wgpu does not let us turn off".into(),
        "dx12" => match wgpu::Dx12Compiler::from_env().unwrap_or_default() {
            wgpu::Dx12Compiler::Fxc => "FXC, by WGPU_DX12_COMPILER".into(),
            wgpu::Dx12Compiler::DynamicDxc { dxc_path } => format!("DXC ({dxc_path})"),
            wgpu::Dx12Compiler::StaticDxc => "DXC, built in".into(),
            wgpu::Dx12Compiler::Auto => "DXC if dxcompiler.dll is on the path, else FXC".into(),
        },
        _ => "the driver's compiler".into(),
    }
}

/// Selects the adapter to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// A GPU, never a software renderer.
    Real,
    /// By its index in [`adapters`] if this is a number, else by a part of its name, in any case. The first match wins.
    Named(String),
}

/// A request to open a device. Only tests and `verify` need more than a [`Wanted`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// The adapter.
    pub choice: Wanted,
    /// Only this pass, instead of the first exact one. [`Pass::Plain`] is not tested.
    pub pass: Option<Pass>,
    /// Use WebGPU's default limits instead of the adapter's own.
    pub default_limits: bool,
    /// Keep bounds checks, loop bounds and zeroed workgroup memory in shaders.
    pub checked: bool,
}

impl From<Wanted> for Request {
    fn from(choice: Wanted) -> Self {
        Request { choice, pass: None, default_limits: false, checked: false }
    }
}

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
    patience: Patience,
    /// Pipelines that the device's tests have compiled, and whether more are kept.
    kept: Arc<Mutex<HashMap<Compiled, wgpu::ComputePipeline>>>,
    keeps: bool,
    /// Faults that tests inject.
    faults: Option<Arc<dyn Faults>>,
}

/// Everything that a pipeline depends on: the text and entry point of its shader, and the pass.
type Compiled = (String, String, Pass);

/// How long to wait for a device that makes no progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// The time of one wait. After the first, the second, the fourth and so on, the device is reported as slow.
    pub wait: Duration,
    /// Waits without progress after which the device counts as lost.
    pub waits: u32,
}

impl Patience {
    /// The patience with a GPU: a message after 10 s, and an error after 2 minutes. No submission takes longer than a
    /// second.
    pub const WITH_GPUS: Patience = Patience { wait: Duration::from_secs(10), waits: 12 };
    /// The patience with a software renderer, which waits for the processor as any other program does: an hour.
    pub const WITH_SOFTWARE: Patience = Patience { wait: Duration::from_secs(10), waits: 360 };
}

/// Reports a device without progress to people, see [`report_stalls`].
static REPORT: OnceLock<fn(&str)> = OnceLock::new();

/// Sets the function that reports to people, in a sentence, that a device makes no progress. Only the first call has an
/// effect.
pub fn report_stalls(report: fn(&str)) {
    let _ = REPORT.set(report);
}

/// Bytes between host and device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// To the device.
    pub up: u64,
    /// From the device.
    pub down: u64,
}

impl std::ops::Sub for Traffic {
    type Output = Traffic;

    fn sub(self, other: Traffic) -> Traffic {
        Traffic { up: self.up - other.up, down: self.down - other.down }
    }
}

impl std::ops::AddAssign for Traffic {
    fn add_assign(&mut self, other: Traffic) {
        (self.up, self.down) = (self.up + other.up, self.down + other.down);
    }
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Gpu").field("adapter", &self.adapter).field("pass", &self.pass).finish_non_exhaustive()
    }
}

/// Returns the adapter of a choice.
pub(super) fn choose(choice: &Wanted) -> Result<(wgpu::Adapter, AdapterInfo), DeviceError> {
    let mut found = found();
    let infos: Vec<_> = found.iter().map(|(_, info)| info.clone()).collect();
    Ok(found.swap_remove(position(choice, &infos)?))
}

/// Returns the index in [`adapters`] of a choice.
///
/// # Errors
/// There is no adapter, none that is a GPU, or none with that name or number.
pub fn position(choice: &Wanted, infos: &[AdapterInfo]) -> Result<usize, DeviceError> {
    match choice {
        Wanted::Named(name) => {
            let part = name.trim().to_lowercase();
            let found = match is_index(&part) {
                true => part.parse().ok().filter(|&index: &usize| index < infos.len()),
                // Every name contains the empty string.
                false if part.is_empty() => None,
                false => infos.iter().position(|info| info.name.to_lowercase().contains(&part)),
            };
            found.ok_or_else(|| DeviceError::UnknownAdapter { name: name.clone(), found: infos.to_vec() })
        }
        // The first adapter is the preferred one.
        Wanted::Real if infos.first().is_some_and(|info| !info.kind.is_real()) => {
            Err(DeviceError::NoRealAdapter { found: infos.to_vec() })
        }
        Wanted::Real if infos.is_empty() => Err(DeviceError::NoAdapter),
        Wanted::Real => Ok(0),
    }
}

/// Offsets of bindings are multiples of this on every WebGPU device.
pub(super) const BINDING_ALIGNMENT: usize = 256;

/// How a shader uses a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binding {
    /// `var<uniform>`.
    Uniform,
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    Write,
}

/// The layout of a pipeline's buffers: group 0, the guard at binding 0, the others from binding 1 on.
#[derive(Clone, Debug)]
pub struct Bindings {
    bindings: wgpu::BindGroupLayout,
    pipeline: wgpu::PipelineLayout,
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
            noted.lock().unwrap_or_else(PoisonError::into_inner).lost.get_or_insert(reason);
        });
        let noted = errors.clone();
        device.on_uncaptured_error(Arc::new(move |error| {
            noted.lock().unwrap_or_else(PoisonError::into_inner).error.get_or_insert(chain(&error));
        }));
        let guard = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("guard"),
            contents: &[0; 16],
            usage: wgpu::BufferUsages::UNIFORM,
        });
        // Another value in each process, because memory may keep nonces of a process before.
        let nonce = Arc::new(AtomicU32::new(host::since_1970().as_nanos() as u32));
        let patience = if info.kind == Kind::Software { Patience::WITH_SOFTWARE } else { Patience::WITH_GPUS };
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
            patience,
            kept: Arc::default(),
            keeps: false,
            faults: None,
        })
    }

    /// Sets how long to wait for a device that makes no progress.
    pub fn waiting(self, patience: Patience) -> Gpu {
        Gpu { patience, ..self }
    }

    /// Returns the device such that the crate's own pipelines that it compiles are reused by its other clones.
    pub(super) fn keeping_pipelines(&self) -> Gpu {
        Gpu { keeps: true, ..self.clone() }
    }

    /// Injects faults, so that tests can show that each is noticed.
    ///
    /// # Safety
    /// Shaders are compiled without bounds checks. An edited shader must keep its indices in bounds and its loops finite,
    /// see [`Gpu::pipeline`].
    #[doc(hidden)]
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    pub unsafe fn failing(self, faults: Arc<dyn Faults>) -> Gpu {
        Gpu { faults: Some(faults), ..self }
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
        let mut errors = self.errors.lock().unwrap_or_else(PoisonError::into_inner);
        let reason = errors.lost.get_or_insert_with(|| reason.into()).clone();
        DeviceError::Lost { adapter: self.adapter.to_string(), reason }
    }

    /// Records that a result lacks its nonce, and returns the error.
    pub(super) fn lose_undone(&self, what: &str) -> DeviceError {
        self.lose(&format!(
            "the driver reports {what} as done, but the device did not do it; a watchdog may have ended it"
        ))
    }

    /// Submits commands. `turns` is their estimated work.
    pub(super) fn submit_commands(
        &self,
        what: &str,
        turns: u64,
        encoder: wgpu::CommandEncoder,
    ) -> wgpu::SubmissionIndex {
        let commands = encoder.finish();
        match &self.faults {
            Some(faults) if faults.drops(what, turns) => self.queue.submit([]),
            _ => self.queue.submit([commands]),
        }
    }

    /// Returns how long work took, or seems to take under injected faults.
    pub(super) fn taken(&self, turns: u64, elapsed: Duration) -> Duration {
        self.faults.as_ref().and_then(|faults| faults.takes(turns)).unwrap_or(elapsed)
    }

    /// Returns how long a rollout took, or seems to take under injected faults.
    pub(super) fn rollout_taken(&self, teams: usize, elapsed: Duration) -> Duration {
        self.faults.as_ref().and_then(|faults| faults.rollout_takes(teams)).unwrap_or(elapsed)
    }

    /// Returns the text of a shader, edited under injected faults.
    fn text<'a>(&self, text: &'a str) -> Cow<'a, str> {
        match &self.faults {
            Some(faults) => faults.edits(text.into()).into(),
            None => text.into(),
        }
    }

    /// Returns an error if the device was lost, or if anything failed outside the calls below. To be called after every
    /// wait.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub fn check(&self) -> Result<(), DeviceError> {
        let mut errors = self.errors.lock().unwrap_or_else(PoisonError::into_inner);
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

    /// Creates a buffer of `bytes` bytes, all zero.
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub fn buffer(&self, what: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer, DeviceError> {
        let mut allowed = self.limits.max_buffer_size;
        if usage.contains(wgpu::BufferUsages::STORAGE) {
            allowed = allowed.min(self.limits.max_storage_buffer_binding_size);
        }
        if usage.contains(wgpu::BufferUsages::UNIFORM) {
            allowed = allowed.min(self.limits.max_uniform_buffer_binding_size);
        }
        if bytes > allowed {
            return Err(DeviceError::TooLarge { adapter: self.adapter.to_string(), what: what.into(), bytes, allowed });
        }
        if self.faults.as_ref().is_some_and(|faults| faults.lacks_memory(what)) {
            return Err(DeviceError::OutOfMemory { adapter: self.adapter.to_string(), what: what.into() });
        }
        let descriptor = wgpu::BufferDescriptor { label: Some(what), size: bytes, usage, mapped_at_creation: false };
        self.scoped(what, || self.device.create_buffer(&descriptor))
    }

    /// Creates a buffer that holds `contents`.
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub fn upload<T: Pod>(
        &self,
        what: &str,
        contents: &[T],
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, DeviceError> {
        let bytes = bytemuck::cast_slice(contents);
        let buffer = self.buffer(what, bytes.len() as u64, usage | wgpu::BufferUsages::COPY_DST)?;
        self.scoped(what, || self.write(&buffer, 0, bytes))?;
        Ok(buffer)
    }

    /// Writes to a buffer (usage `COPY_DST`) before everything that is submitted from now on.
    pub fn write(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        self.traffic[0].fetch_add(bytes.len() as u64, Relaxed);
        self.queue.write_buffer(buffer, offset, bytes);
    }

    /// Returns the bytes written to and read from the device since it was opened.
    pub fn traffic(&self) -> Traffic {
        let [up, down] = [0, 1].map(|way| self.traffic[way].load(Relaxed));
        Traffic { up, down }
    }

    /// Waits for all work, and reads ranges of buffers, one after another (in bytes, multiples of 4; usage `COPY_SRC`).
    ///
    /// # Errors
    /// The device was lost, or has too little memory for the copy.
    pub fn read<T: Pod>(&self, ranges: &[(&wgpu::Buffer, Range<u64>)]) -> Result<Vec<T>, DeviceError> {
        let size = ranges.iter().map(|(_, bytes)| bytes.end - bytes.start).sum();
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let landing = self.buffer("reading back", size, usage)?;
        self.scoped("reading back", || {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            let mut to = 0;
            for (buffer, bytes) in ranges {
                encoder.copy_buffer_to_buffer(buffer, bytes.start, &landing, to, bytes.end - bytes.start);
                to += bytes.end - bytes.start;
            }
            self.submit_commands("reading back", 0, encoder);
        })?;
        self.wait()?;
        self.mapped(&landing, 0..size, bytemuck::pod_collect_to_vec)
    }

    /// Calls `show` with a range of a buffer (in bytes, multiples of 4; usage `MAP_READ`). All work that writes it must
    /// have been waited for.
    ///
    /// # Errors
    /// The device was lost, or the buffer cannot be read.
    pub fn mapped<T>(
        &self,
        buffer: &wgpu::Buffer,
        bytes: Range<u64>,
        show: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, DeviceError> {
        self.traffic[1].fetch_add(bytes.end - bytes.start, Relaxed);
        let (send, receive) = oneshot::channel();
        // The receiver is dropped only after an error.
        self.scoped("reading back", || {
            buffer.map_async(wgpu::MapMode::Read, bytes.clone(), move |result| drop(send.send(result)));
        })?;
        // The work is done, so one poll completes the mapping.
        let polled = self.device.poll(wgpu::PollType::Poll);
        self.check()?;
        polled.map_err(|error| self.failed("reading back", error))?;
        let mapped = host::wait(receive).map_err(|error| self.failed("reading back", error))?;
        mapped.map_err(|error| self.failed("reading back", error))?;
        let view = buffer.get_mapped_range(bytes).map_err(|error| self.failed("reading back", error))?;
        let instead = self.faults.as_ref().and_then(|faults| faults.reads(buffer, &view));
        let shown = show(instead.as_deref().unwrap_or(&view));
        drop(view);
        buffer.unmap();
        Ok(shown)
    }

    /// Waits until everything submitted is done.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub fn wait(&self) -> Result<(), DeviceError> {
        self.wait_for(None)
    }

    /// Waits until a submission is done, or everything.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub fn wait_for(&self, submission_index: Option<wgpu::SubmissionIndex>) -> Result<(), DeviceError> {
        // A browser cannot poll. There, this waits for everything submitted so far.
        if cfg!(target_family = "wasm") {
            let (send, done) = oneshot::channel();
            self.queue.on_submitted_work_done(move || _ = send.send(()));
            // If nobody answers, the device was lost; `check` reports that.
            let _ = host::wait(done);
            return self.check();
        }
        let Patience { wait, waits } = self.patience;
        for waited in 1..=waits {
            let wanted = wgpu::PollType::Wait { submission_index: submission_index.clone(), timeout: Some(wait) };
            let polled = match self.faults.as_ref().is_some_and(|faults| faults.stalls()) {
                true => Err(wgpu::PollError::Timeout),
                false => self.device.poll(wanted),
            };
            self.check()?;
            match polled {
                Ok(_) => return Ok(()),
                Err(wgpu::PollError::Timeout) => {
                    let (seconds, most) = ((wait * waited).as_secs_f64(), (wait * waits).as_secs_f64());
                    REPORT.get().filter(|_| waited.is_power_of_two()).inspect(|report| {
                        report(&format!(
                            "{}: no progress for {seconds:.0} s; it counts as lost after {most:.0} s",
                            self.adapter
                        ));
                    });
                }
                Err(error) => return Err(self.failed("waiting", error)),
            }
        }
        Err(self.lose(&format!("no progress for {:.0} s", (wait * waits).as_secs_f64())))
    }

    /// Returns the layout of a pipeline that uses these buffers as bindings 1, 2, … of group 0.
    ///
    /// # Errors
    /// The device does not support so many buffers.
    pub fn layout(&self, label: &str, buffers: &[Binding]) -> Result<Bindings, DeviceError> {
        let entry = |(binding, &kind): (u32, &Binding)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match kind {
                    Binding::Uniform => wgpu::BufferBindingType::Uniform,
                    Binding::Read => wgpu::BufferBindingType::Storage { read_only: true },
                    Binding::Write => wgpu::BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let entries: Vec<_> = (0..).zip(std::iter::once(&Binding::Uniform).chain(buffers)).map(entry).collect();
        self.scoped(label, || {
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries };
            let bindings = self.device.create_bind_group_layout(&descriptor);
            let pipeline = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(label),
                bind_group_layouts: &[Some(&bindings)],
                immediate_size: 0,
            });
            Bindings { bindings, pipeline }
        })
    }

    /// Binds buffers for a pipeline, in the order of its layout.
    ///
    /// # Errors
    /// A buffer does not fit its binding.
    pub fn bind(
        &self,
        label: &str,
        layout: &Bindings,
        buffers: &[wgpu::BufferBinding<'_>],
    ) -> Result<wgpu::BindGroup, DeviceError> {
        let all = std::iter::once(self.guard.as_entire_buffer_binding()).chain(buffers.iter().cloned());
        let entries: Vec<_> = (0..)
            .zip(all)
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Buffer(buffer) })
            .collect();
        let descriptor = wgpu::BindGroupDescriptor { label: Some(label), layout: &layout.bindings, entries: &entries };
        self.scoped(label, || self.device.create_bind_group(&descriptor))
    }

    /// Compiles one of the crate's own shaders, see [`Gpu::pipeline`].
    pub(crate) fn own_pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
        layout: &Bindings,
    ) -> Result<wgpu::ComputePipeline, DeviceError> {
        let key = (self.text(wgsl).into_owned(), entry.to_owned(), self.pass);
        let kept = |key: &Compiled| self.kept.lock().unwrap_or_else(PoisonError::into_inner).get(key).cloned();
        if let Some(pipeline) = kept(&key) {
            return Ok(pipeline);
        }
        // SAFETY: the loops of the crate's own shaders end, their bindings are those of their layouts, and their
        // indices are in bounds for groups and plans that were checked, as the checked builds in the tests show.
        #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
        let pipeline = unsafe { self.pipeline(label, &key.0, entry, layout) }?;
        if self.keeps {
            self.kept.lock().unwrap_or_else(PoisonError::into_inner).insert(key, pipeline.clone());
        }
        Ok(pipeline)
    }

    /// Compiles an entry point under the device's pass. Workgroup memory starts undefined unless `checked`.
    ///
    /// # Safety
    /// Unless `checked`, the shader is compiled without bounds checks. Its indices must be in bounds, and its loops
    /// must end. It must not divide an integer by zero, or read workgroup memory that it did not write. Its bindings
    /// must match the layout, `checked` or not.
    ///
    /// # Errors
    /// The shader leaves the exact core, exceeds the device's limits, or the driver refuses it.
    #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
    pub unsafe fn pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
        layout: &Bindings,
    ) -> Result<wgpu::ComputePipeline, DeviceError> {
        let compiled = self.scoped(label, || {
            // SAFETY: see the function's own contract.
            unsafe { exact::compile(&self.device, label, wgsl, self.pass, self.checked) }
        })?;
        let module = compiled.map_err(|source| DeviceError::Shader { label: label.into(), source })?;
        let descriptor = wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: Some(&layout.pipeline),
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: self.checked,
                ..Default::default()
            },
            cache: None,
        };
        self.scoped(label, || self.device.create_compute_pipeline(&descriptor))
    }

    /// Submits one dispatch, without waiting for it.
    ///
    /// # Errors
    /// The device was lost, or refuses the dispatch.
    pub fn dispatch(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        workgroups: [u32; 3],
    ) -> Result<(), DeviceError> {
        self.submit(what, pipeline, buffers, workgroups, None)
    }

    fn submit(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        [x, y, z]: [u32; 3],
        watch: Option<&Stopwatch>,
    ) -> Result<(), DeviceError> {
        self.scoped(what, || {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&timed(watch));
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, buffers, &[]);
            pass.dispatch_workgroups(x, y, z);
            drop(pass);
            watch.inspect(|watch| watch.stop(&mut encoder));
            self.queue.submit([encoder.finish()]);
        })
    }

    /// Returns how long one dispatch takes: by the device's clock if it has one, else from submission to completion.
    ///
    /// # Errors
    /// The device was lost, or refuses the dispatch.
    pub fn time(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        workgroups: [u32; 3],
    ) -> Result<Duration, DeviceError> {
        let watch = self.stopwatch()?;
        self.wait()?;
        let start = Instant::now();
        self.submit(what, pipeline, buffers, workgroups, watch.as_ref())?;
        self.wait()?;
        let elapsed = start.elapsed();
        match watch {
            // Some software drivers have a clock that stands still.
            Some(watch) => Ok(Some(watch.read(self)?).filter(|time| !time.is_zero()).unwrap_or(elapsed)),
            None => Ok(elapsed),
        }
    }

    /// Reports whether the device has a clock.
    pub fn has_clock(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }

    /// Returns a stopwatch, if the device has a clock.
    ///
    /// # Errors
    /// There is too little memory.
    pub fn stopwatch(&self) -> Result<Option<Stopwatch>, DeviceError> {
        if !self.has_clock() {
            return Ok(None);
        }
        let bytes = 2 * u64::from(wgpu::QUERY_SIZE);
        let queries = self.scoped("timestamps", || {
            let (label, ty) = (Some("timestamps"), wgpu::QueryType::Timestamp);
            self.device.create_query_set(&wgpu::QuerySetDescriptor { label, ty, count: 2 })
        })?;
        use wgpu::BufferUsages as Usage;
        let ticks = self.buffer("timestamps", bytes, Usage::QUERY_RESOLVE | Usage::COPY_SRC)?;
        let landing = self.buffer("timestamps, read back", bytes, Usage::COPY_DST | Usage::MAP_READ)?;
        Ok(Some(Stopwatch { queries, ticks, landing }))
    }
}

/// Times one compute pass by the device's clock.
pub struct Stopwatch {
    queries: wgpu::QuerySet,
    ticks: wgpu::Buffer,
    landing: wgpu::Buffer,
}

impl Stopwatch {
    /// Copies the times of the pass to the host, after it.
    pub fn stop(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.resolve_query_set(&self.queries, 0..2, &self.ticks, 0);
        encoder.copy_buffer_to_buffer(&self.ticks, 0, &self.landing, 0, self.ticks.size());
    }

    /// Returns how long the last submitted pass took, which must have been waited for.
    ///
    /// # Errors
    /// The device was lost.
    pub fn read(&self, gpu: &Gpu) -> Result<Duration, DeviceError> {
        let read = |bytes: &[u8]| bytemuck::pod_collect_to_vec::<u8, u64>(bytes);
        let ticks = gpu.mapped(&self.landing, 0..self.landing.size(), read)?;
        let period = f64::from(gpu.queue.get_timestamp_period());
        Ok(Duration::from_nanos((ticks[1].saturating_sub(ticks[0]) as f64 * period) as u64))
    }
}

/// Describes a compute pass, timed if there is a stopwatch.
pub fn timed(watch: Option<&Stopwatch>) -> wgpu::ComputePassDescriptor<'_> {
    let timestamp_writes = watch.map(|watch| wgpu::ComputePassTimestampWrites {
        query_set: &watch.queries,
        beginning_of_pass_write_index: Some(0),
        end_of_pass_write_index: Some(1),
    });
    wgpu::ComputePassDescriptor { label: None, timestamp_writes }
}

/// Returns a grid of at least `tasks` workgroups, within the device's limit on each dimension.
pub(super) fn grid(tasks: usize, limits: &wgpu::Limits) -> [u32; 3] {
    let rows = tasks.div_ceil(limits.max_compute_workgroups_per_dimension as usize).max(1);
    [tasks.div_ceil(rows) as u32, rows as u32, 1]
}

/// Formats an error with all its causes.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let inner = error.to_string();
        if !text.contains(&inner) {
            text += &format!(": {inner}");
        }
        cause = error.source();
    }
    text
}
