//! Available memory on Linux, by the files of `/proc` and of both versions of control groups.

use std::fs;
use std::path::Path;

/// Returns the bytes that this process may still use, or `None` if the system does not report them. The system's files
/// are below `root`.
pub(super) fn available(root: &Path) -> Option<u64> {
    let read = |path: &str| fs::read_to_string(root.join(path)).ok();
    let kib = |text: String, name: &str| field(&text, name).map(|kib| kib.saturating_mul(1024));
    let free = kib(read("proc/meminfo")?, "MemAvailable:")?;
    let address_space = || {
        let most = field(&read("proc/self/limits")?, "Max address space")?;
        Some(most.saturating_sub(kib(read("proc/self/status")?, "VmSize:")?))
    };
    let groups = read("proc/self/cgroup").unwrap_or_default();
    let limits = groups.lines().flat_map(|line| limits_of_group(root, line));
    limits.chain(address_space()).chain([free]).min()
}

/// Returns what the memory limits of a control group and of its parent groups leave. `line` is the line of the group in
/// `/proc/self/cgroup`. Its format is `0::/path` in version 2 and `number:controllers:/path` in version 1.
fn limits_of_group(root: &Path, line: &str) -> Vec<u64> {
    let mut parts = line.splitn(3, ':').skip(1);
    let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else { return vec![] };
    // Per version: the folder, the file with the limit, and the memory in use without files, which can be dropped.
    let (mount, limit, held) = match controllers {
        "" => ("sys/fs/cgroup", "memory.max", "anon "),
        _ if controllers.split(',').any(|name| name == "memory") => {
            ("sys/fs/cgroup/memory", "memory.limit_in_bytes", "total_rss ")
        }
        _ => return vec![],
    };
    let left = |group: &Path| -> Option<u64> {
        let group = root.join(mount).join(group.strip_prefix("/").unwrap_or(group));
        let read = |file: &str| fs::read_to_string(group.join(file)).ok();
        let most: u64 = read(limit)?.trim().parse().ok()?;
        Some(most.saturating_sub(field(&read("memory.stat")?, held).unwrap_or(0)))
    };
    // In a container the path may be that of the host. Only the group at the top exists in that case.
    Path::new(path).ancestors().filter_map(left).collect()
}

/// Returns the number after a name at the start of a line.
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next()?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found_by_name() {
        let text = "MemTotal:       25000000 kB\nMemAvailable:   12 kB\nanon 7\nanon_thp 9\n";
        assert_eq!(field(text, "MemAvailable:"), Some(12));
        assert_eq!(field(text, "anon "), Some(7));
        assert_eq!(field(text, "none"), None);
    }

    /// Creates a folder with files like those of Linux.
    fn system(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        root
    }

    #[test]
    fn every_limit_of_the_system_counts() {
        const FREE: (&str, &str) = ("proc/meminfo", "MemTotal: 9000 kB\nMemAvailable:    8000 kB\n");
        const NONE: &str = "9223372036854771712\n";
        let available = |files: &[(&str, &str)]| super::available(system(files).path());
        assert_eq!(available(&[]), None);
        assert_eq!(available(&[FREE]), Some(8_192_000));
        // Version 2: the parent group has a limit, and the group itself has "max".
        let second = [
            FREE,
            ("proc/self/cgroup", "0::/jobs/one\n"),
            ("sys/fs/cgroup/jobs/one/memory.max", "max\n"),
            ("sys/fs/cgroup/jobs/one/memory.stat", "anon 100000\nfile 7\n"),
            ("sys/fs/cgroup/jobs/memory.max", "5000000\n"),
            ("sys/fs/cgroup/jobs/memory.stat", "anon 1000000\nanon_thp 9\n"),
        ];
        assert_eq!(available(&second), Some(4_000_000));
        // Version 1, as Slurm creates groups: the job has a limit, and its step has none.
        let first = [
            FREE,
            ("proc/self/cgroup", "5:cpuset:/\n4:hugetlb,memory:/slurm/job_7/step_0\n0::/\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", NONE),
            ("sys/fs/cgroup/memory/memory.stat", "total_rss 6000000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/memory.limit_in_bytes", "3000000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/memory.stat", "cache 5\nrss 7\ntotal_cache 9\ntotal_rss 500000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/step_0/memory.limit_in_bytes", NONE),
            ("sys/fs/cgroup/memory/slurm/job_7/step_0/memory.stat", "total_rss 500000\n"),
        ];
        assert_eq!(available(&first), Some(2_500_000));
        // Version 1 in a container: the path is that of the host.
        let contained = [
            FREE,
            ("proc/self/cgroup", "4:memory:/docker/0123\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "2000000\n"),
            ("sys/fs/cgroup/memory/memory.stat", "total_rss 0\n"),
        ];
        assert_eq!(available(&contained), Some(2_000_000));
        // `ulimit -v`.
        let limited = "Limit                     Soft Limit           Hard Limit           Units     \n\
                       Max address space         3000000              unlimited            bytes     \n";
        let status = ("proc/self/status", "Name:\tx\nVmSize:\t    1000 kB\n");
        assert_eq!(available(&[FREE, ("proc/self/limits", limited), status]), Some(1_976_000));
        let unlimited = limited.replace("3000000  ", "unlimited");
        assert_eq!(available(&[FREE, ("proc/self/limits", &unlimited), status]), Some(8_192_000));
    }
}
