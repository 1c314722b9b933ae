//! The GPU backend, on any adapter that wgpu reaches.
