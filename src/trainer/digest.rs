//! The digest of a training: what has to be equal on every machine.

use sha2::{Digest, Sha256};

use super::Row;

/// Returns the columns of a row that have the same bits on every backend. `tested` rows have a column more.
pub const fn columns(tested: bool) -> &'static str {
    if tested {
        "trial,generation,best_g,mean_g,champion_g,test_g"
    } else {
        "trial,generation,best_g,mean_g,champion_g"
    }
}

/// Returns a row as text, in the order of [`columns`].
pub fn line(row: &Row) -> String {
    let Row { trial, generation, best_g, mean_g, champion_g, test_g, .. } = row;
    let test_g = test_g.map_or(String::new(), |test_g| format!(",{test_g}"));
    format!("{trial},{generation},{best_g},{mean_g},{champion_g}{test_g}")
}

/// Returns the digest of a training: SHA-256 of [`columns`] and its rows, one per line, and then of its policies.
pub fn digest(rows: impl Iterator<Item = Row>, policies: &[impl AsRef<[f32]>]) -> [u8; 32] {
    let (mut hash, mut rows) = (Sha256::new(), rows.peekable());
    let tested = rows.peek().is_some_and(|row| row.test_g.is_some());
    for text in std::iter::once(columns(tested).to_string()).chain(rows.map(|row| line(&row))) {
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
