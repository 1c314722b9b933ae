//! Why no GPU is found: what is usual on this system, in words.

use std::path::Path;

/// Where the Vulkan loader usually is on Linux.
const LOADERS: [&str; 6] = [
    "/usr/lib/x86_64-linux-gnu/libvulkan.so.1",
    "/usr/lib/aarch64-linux-gnu/libvulkan.so.1",
    "/usr/lib64/libvulkan.so.1",
    "/usr/lib/libvulkan.so.1",
    "/lib64/libvulkan.so.1",
    "/run/opengl-driver/lib/libvulkan.so.1",
];

/// Returns the likely reasons why there is no adapter at all, on this system.
pub(super) fn reasons() -> String {
    match found() {
        found if found.is_empty() => "no Vulkan, Metal or DirectX 12 driver answers".into(),
        found => found.join("; "),
    }
}

/// Returns the same reasons as the end of a message, each after a semicolon. Empty if none is known.
pub(super) fn hints() -> String {
    found().into_iter().map(|reason| format!("; {reason}")).collect()
}

fn found() -> Vec<String> {
    let exists = |path: &str| Path::new(path).exists();
    reasons_of(cfg!(target_os = "linux"), &exists, &|name| std::env::var(name).ok())
}

/// Returns the likely reasons on a system with these files and environment variables.
fn reasons_of(linux: bool, exists: &dyn Fn(&str) -> bool, variable: &dyn Fn(&str) -> Option<String>) -> Vec<String> {
    let mut reasons = Vec::new();
    for name in ["WGPU_BACKEND", "VK_DRIVER_FILES", "VK_ICD_FILENAMES"] {
        if let Some(value) = variable(name).filter(|value| !value.is_empty()) {
            reasons.push(format!("{name}={} hides all other drivers", crate::escape::line(&value)));
        }
    }
    if !linux {
        return reasons;
    }
    if !LOADERS.iter().any(|path| exists(path)) {
        reasons.push("the Vulkan loader is missing (install libvulkan1 or vulkan-loader)".into());
    }
    if exists("/dev/dxg") {
        let text = "under WSL, GPUs answer through Mesa's dzn (install mesa-vulkan-drivers), which does not conform: \
                    WGPU_ALLOW_UNDERLYING_NONCOMPLIANT_ADAPTER=1 allows it";
        reasons.push(text.into());
    } else if exists("/dev/nvidiactl") {
        let text = "there is an NVIDIA GPU, but not its Vulkan driver: in a container, start it with \
                    NVIDIA_DRIVER_CAPABILITIES=all; else install the driver's libnvidia-gl package";
        reasons.push(text.into());
    } else if exists("/dev/dri/renderD128") {
        reasons.push("there is a GPU, but not its Vulkan driver (install mesa-vulkan-drivers)".into());
    } else if exists("/dev/dri") {
        reasons.push("/dev/dri has no render device that this user may see".into());
    }
    reasons
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(files: &[&str], variables: &[(&str, &str)]) -> String {
        let variable = |name: &str| {
            let found = variables.iter().find(|(known, _)| *known == name);
            found.map(|(_, value)| value.to_string())
        };
        reasons_of(true, &|path| files.contains(&path), &variable).join("; ")
    }

    #[test]
    fn usual_reasons_are_named() {
        let loader = LOADERS[0];
        assert_eq!(with(&[loader], &[]), "");
        assert!(with(&[], &[]).contains("libvulkan1"));
        assert!(with(&[loader, "/dev/nvidiactl"], &[]).contains("NVIDIA_DRIVER_CAPABILITIES=all"));
        assert!(with(&[loader, "/dev/dxg"], &[]).contains("WGPU_ALLOW_UNDERLYING_NONCOMPLIANT_ADAPTER=1"));
        assert!(with(&[loader, "/dev/dri/renderD128"], &[]).contains("mesa-vulkan-drivers"));
        let hidden = with(&[loader], &[("VK_DRIVER_FILES", "/nonexistent")]);
        assert_eq!(hidden, "VK_DRIVER_FILES=/nonexistent hides all other drivers");
    }
}
