//! `paper.toml`, which identifies the paper in a folder.

use std::path::Path;

use super::products;
use flotilla::config::{self, Learning};
use flotilla::escape::PathExt;
use flotilla_app::ops::{Error, with_remedy};
use flotilla_app::record::RecordError;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{self, ARMS, PAPER, POINTS, SWEEP, Start};
use flotilla_app::record::ownership;

/// The keys that all experiments of a paper have in common, with their values.
pub(super) struct Identity([(&'static str, u64); 3]);

impl Identity {
    pub(super) fn of(learning: &Learning) -> Identity {
        let generations = learning.generations as u64;
        Identity([("seed", learning.seed), ("trials", learning.trials as u64), ("generations", generations)])
    }

    fn text(&self) -> String {
        self.0.iter().map(|(key, value)| format!("{key} = {value}\n")).collect()
    }

    /// Checks that a paper may be written into a folder.
    ///
    /// # Errors
    /// The folder holds something else, or a paper that `start` does not allow to be resumed or replaced.
    pub(super) fn check(&self, out: &Path, start: Start) -> Result<(), Error> {
        if out.is_file() {
            return Err(RecordError::no_folder(out).into());
        }
        let name = out.escaped();
        let holds = |file: &str| out.join(file).exists();
        let refused = |reason: String, remedy: &str| Err(Error::Refused(with_remedy(reason, remedy)));
        if holds(PAPER) {
            return match start {
                Start::Fresh => refused(
                    format!("{name} holds a paper already"),
                    "pass --resume to continue it or --force to overwrite it, or choose another --out",
                ),
                Start::Force => self.check_origin(out),
                Start::Resume => self.check_resumed(out),
            };
        }
        if holds(SWEEP) || holds(POINTS) {
            return refused(format!("{name} holds a sweep, no paper"), "choose another --out");
        }
        if folder::holds_run(out)? {
            return refused(format!("{name} holds a run, no paper"), "choose another --out");
        }
        if let Some(file) = [ARMS.to_string()].into_iter().chain(products()).find(|file| holds(file)) {
            return refused(
                format!("{name} holds {file} but no {PAPER}, so it is not the folder of a paper"),
                "choose another --out",
            );
        }
        Ok(())
    }

    /// Refuses to replace a folder whose `paper.toml` was not written by flotilla.
    fn check_origin(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let existing: Option<toml::Table> = config::read_file(&path)?.parse().ok();
        let has_keys = existing.is_some_and(|existing| self.0.iter().all(|(key, _)| existing.contains_key(*key)));
        match has_keys || out.join(ARMS).is_dir() {
            true => Ok(()),
            false => Err(RecordError::NotOurs(path).into()),
        }
    }

    /// Refuses to resume another paper. Only the number of generations may be larger than before.
    fn check_resumed(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let text = config::read_file(&path)?;
        let existing: toml::Table = text.parse().map_err(|error: toml::de::Error| RecordError::Damaged {
            path: path.clone(),
            reason: format!("it is damaged: {}; pass --force to overwrite the paper", error.message()),
        })?;
        let differs = |&(key, requested): &(&str, u64)| {
            let found = existing.get(key).and_then(toml::Value::as_integer).and_then(|found| u64::try_from(found).ok());
            match found {
                Some(found) if found == requested || key == "generations" && found < requested => None,
                Some(found) => Some(format!("\n  {key}: {found} there, {requested} here")),
                None => Some(format!("\n  {key}: nothing there, {requested} here")),
            }
        };
        let differences: String = self.0.iter().filter_map(differs).collect();
        if differences.is_empty() {
            return Ok(());
        }
        Err(Error::Refused(with_remedy(
            format!("{} holds another paper; what differs:{differences}", out.escaped()),
            "use its own flags (generations may be more), or choose another --out",
        )))
    }

    /// Writes `paper.toml`. `Start::Force` first removes the files that were made from earlier runs.
    ///
    /// # Errors
    /// A file cannot be removed or written.
    pub(super) fn write(&self, out: &Path, start: Start, disk: &Disk) -> Result<(), Error> {
        if start == Start::Force {
            products().try_for_each(|name| ownership::remove_published(disk, &out.join(name)))?;
        }
        let path = out.join(PAPER);
        Ok(disk.replace(&path, |output| output.write_all(self.text().as_bytes())).map_err(RecordError::write(&path))?)
    }
}
