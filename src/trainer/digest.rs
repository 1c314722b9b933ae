//! The digest of a training: what has to be equal on every machine.

use sha2::{Digest, Sha256};

use super::Row;

/// Columns of a row that have the same bits on every backend.
const COLUMNS: &str = "trial,generation,best_g,mean_g,champion_g";

/// Returns a row as text, in the order of [`COLUMNS`].
pub fn line(row: &Row) -> String {
    let Row { trial, generation, best_g, mean_g, champion_g, .. } = row;
    format!("{trial},{generation},{best_g},{mean_g},{champion_g}")
}

/// Returns the digest of a training: SHA-256 of [`COLUMNS`] and its rows, one per line, and then of its policies.
pub fn digest(rows: impl Iterator<Item = Row>, policies: &[impl AsRef<[f32]>]) -> [u8; 32] {
    let mut hash = Sha256::new();
    for text in std::iter::once(COLUMNS.to_string()).chain(rows.map(|row| line(&row))) {
        hash.update(text);
        hash.update("\n");
    }
    policies.iter().for_each(|weights| hash.update(bytemuck::cast_slice::<f32, u8>(weights.as_ref())));
    hash.finalize().into()
}

/// Formats bytes as lowercase hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
