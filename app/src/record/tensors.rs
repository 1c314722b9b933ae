//! Safetensors files with a checksum.
//!
//! Other programs can read such a file as plain safetensors. Its metadata has two more keys. `flotilla` gives the kind
//! of the file and the version of its format. `sha256` is the checksum of the whole file, computed with the 64 digits
//! of the checksum set to 0.
//!
//! Files of other programs have neither key and are read without a check. A single damaged byte cannot hide both keys,
//! so it cannot disable the check.

use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};

use safetensors::tensor::{Dtype, Metadata, TensorInfo};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::disk::Place;
use super::{RecordError, hash_rest, hex};

/// Maximum size of a file's header in bytes.
pub const MAX_HEADER_BYTES: u64 = 1 << 20;
const KIND: &str = "flotilla";
const CHECKSUM: &str = "sha256";
/// Metadata key of the program version that wrote the file. Not all files have it.
pub(super) const VERSION: &str = "version";
const NO_CHECKSUM: &str = "0000000000000000000000000000000000000000000000000000000000000000";

#[cfg(target_endian = "big")]
compile_error!("safetensors hold little-endian numbers, which are read and written in place");

/// A tensor to write. Its data is given in consecutive parts.
pub struct Tensor<'a> {
    /// Name in the file, such as `weights.0`.
    pub name: String,
    pub dtype: Dtype,
    /// Shape, in row-major order.
    pub shape: Vec<usize>,
    /// Little-endian data. The total length matches the shape.
    pub parts: Vec<&'a [u8]>,
}

impl<'a> Tensor<'a> {
    pub fn floats(name: String, shape: Vec<usize>, parts: impl IntoIterator<Item = &'a [f32]>) -> Tensor<'a> {
        Tensor { name, dtype: Dtype::F32, shape, parts: parts.into_iter().map(bytemuck::cast_slice).collect() }
    }
}

/// Writes the content of a file of a kind (such as "policies 1") to a stream. Returns its checksum.
pub fn put<'a>(
    output: &mut dyn Write,
    kind: &str,
    metadata: impl IntoIterator<Item = (&'a str, String)>,
    tensors: &[Tensor<'_>],
) -> io::Result<String> {
    let mut metadata: Map<_, _> = metadata.into_iter().map(|(key, value)| (key.into(), value.into())).collect();
    metadata.insert(KIND.into(), kind.into());
    metadata.insert(CHECKSUM.into(), NO_CHECKSUM.into());
    let mut header = Map::from_iter([("__metadata__".to_string(), Value::Object(metadata))]);
    let mut end = 0;
    for Tensor { name, dtype, shape, parts } in tensors {
        let start = end;
        end += parts.iter().map(|part| part.len()).sum::<usize>();
        header.insert(
            name.clone(),
            json!(TensorInfo { dtype: *dtype, shape: shape.clone(), data_offsets: (start, end) }),
        );
    }
    let mut header = Value::Object(header).to_string();
    // The header is padded so that the tensors start at a multiple of 8.
    header.extend(std::iter::repeat_n(' ', header.len().next_multiple_of(8) - header.len()));

    let length = (header.len() as u64).to_le_bytes();
    let mut hash = Sha256::new_with_prefix(length).chain_update(&header);
    let parts = || tensors.iter().flat_map(|tensor| &tensor.parts);
    parts().for_each(|part| hash.update(part));
    let checksum = hex(&hash.finalize());
    let header = header.replacen(NO_CHECKSUM, &checksum, 1);
    output.write_all(&length)?;
    output.write_all(header.as_bytes())?;
    parts().try_for_each(|part| output.write_all(part))?;
    Ok(checksum)
}

/// An open file with a valid header. If the file has a checksum, it matches.
pub struct TensorFile<R> {
    source: BufReader<R>,
    header: Metadata,
    /// Offset of the first tensor in bytes.
    start: u64,
}

impl<R: Read + Seek> TensorFile<R> {
    /// Opens a file and verifies its checksum.
    pub fn open(source: R) -> Result<TensorFile<R>, String> {
        let mut source = BufReader::with_capacity(1 << 16, source);
        let describe = |error: io::Error| match error.kind() {
            io::ErrorKind::UnexpectedEof => "it is cut short".to_string(),
            _ => format!("cannot be read: {error}"),
        };
        let size = source.seek(SeekFrom::End(0)).and_then(|size| source.rewind().map(|()| size)).map_err(describe)?;
        let mut length = [0; 8];
        source.read_exact(&mut length).map_err(describe)?;
        let header_bytes = u64::from_le_bytes(length);
        if header_bytes > MAX_HEADER_BYTES {
            let most = MAX_HEADER_BYTES;
            return Err(match header_bytes < size {
                true => format!("its header is over {most} bytes ({header_bytes})"),
                false => "it is not a safetensors file".into(),
            });
        }
        let start = 8 + header_bytes;
        if size < start {
            return Err("it is cut short".into());
        }
        let mut text = vec![0; header_bytes as usize];
        source.read_exact(&mut text).map_err(describe)?;
        let header: Metadata =
            serde_json::from_slice(&text).map_err(|error| format!("its safetensors header is damaged: {error}"))?;
        if (header.data_len() as u64).checked_add(start) != Some(size) {
            return Err(format!(
                "it is cut short or has too much: {} bytes of tensors, not {}",
                size - start,
                header.data_len()
            ));
        }
        let mut file = TensorFile { source, header, start };
        if file.metadata(KIND).is_some() || file.metadata(CHECKSUM).is_some() {
            file.verify(length, text)?;
        }
        Ok(file)
    }

    /// Compares the checksum with the content.
    fn verify(&mut self, length: [u8; 8], mut header: Vec<u8>) -> Result<(), String> {
        const DAMAGED: &str = "it is damaged: its checksum does not fit";
        let checksum = self.metadata(CHECKSUM).filter(|checksum| checksum.len() == NO_CHECKSUM.len()).ok_or(DAMAGED)?;
        let place = header.windows(checksum.len()).position(|window| window == checksum.as_bytes()).ok_or(DAMAGED)?;
        header[place..place + NO_CHECKSUM.len()].copy_from_slice(NO_CHECKSUM.as_bytes());
        let checksum = checksum.to_string();
        let mut hash = Sha256::new_with_prefix(length).chain_update(&header);
        hash_rest(&mut self.source, &mut hash).map_err(|error| format!("cannot be read: {error}"))?;
        if hex(&hash.finalize()) == checksum { Ok(()) } else { Err(DAMAGED.into()) }
    }

    /// Returns the verified checksum, or `None` for a file of another program.
    pub fn checksum(&self) -> Option<&str> {
        self.metadata(CHECKSUM)
    }

    /// Returns the kind of the file, or `None` for a file of another program.
    pub fn kind(&self) -> Option<&str> {
        self.metadata(KIND)
    }

    pub(crate) fn metadata(&self, key: &str) -> Option<&str> {
        self.header.metadata().as_ref()?.get(key).map(String::as_str)
    }

    /// Returns the type and shape of a tensor.
    pub fn info(&self, name: &str) -> Option<&TensorInfo> {
        self.header.info(name)
    }

    pub fn names(&self) -> Vec<String> {
        self.header.offset_keys()
    }

    /// Reads the numbers of a tensor, split into `parts` equal parts.
    pub fn read<T: bytemuck::Pod>(
        &mut self,
        name: &str,
        dtype: Dtype,
        shape: &[usize],
        parts: usize,
    ) -> Result<Vec<Vec<T>>, String> {
        let info = self.info(name).ok_or_else(|| format!("it has no tensor {name}"))?;
        if info.dtype != dtype || info.shape != shape {
            return Err(format!("{name} is {:?} {:?}, not {dtype:?} {shape:?}", info.dtype, info.shape));
        }
        let (start, end) = info.data_offsets;
        let count = (end - start) / size_of::<T>() / parts;
        let describe = |error: io::Error| format!("cannot be read: {error}");
        self.source.seek(SeekFrom::Start(self.start + start as u64)).map_err(describe)?;
        let part = |_| {
            let mut values = Vec::new();
            let refused = |_| format!("not enough memory for the {} bytes of {name}", end - start);
            values.try_reserve_exact(count).map_err(refused)?;
            values.resize(count, T::zeroed());
            self.source.read_exact(bytemuck::cast_slice_mut(&mut values)).map_err(describe)?;
            Ok(values)
        };
        (0..parts).map(part).collect()
    }
}

/// Checks whether a file has a newer format than this program writes. If so, returns the version that wrote it, or
/// `Some(None)` if the file does not contain it. A file that cannot be read gives `None`.
pub(crate) fn newer(place: Place<'_>) -> Option<Option<String>> {
    let mut file = place.open().ok()?;
    let mut length = [0; 8];
    file.read_exact(&mut length).ok()?;
    let mut header = vec![0; usize::try_from(u64::from_le_bytes(length).min(MAX_HEADER_BYTES)).ok()?];
    file.read_exact(&mut header).ok()?;
    let header: Metadata = serde_json::from_slice(&header).ok()?;
    let metadata = header.metadata().as_ref()?;
    // All current formats have version 1. A damaged byte may look like a newer version, but then the checksum does not
    // match.
    let (_, format) = metadata.get(KIND)?.rsplit_once(' ')?;
    let later = format.parse::<u64>().ok()? > 1 && open(place).is_ok();
    later.then(|| metadata.get(VERSION).cloned())
}

pub fn open<'a>(place: impl Into<Place<'a>>) -> Result<TensorFile<std::fs::File>, RecordError> {
    let place = place.into();
    let file = place.open().map_err(RecordError::read(place.path()))?;
    TensorFile::open(file).map_err(|reason| RecordError::damaged(place.path(), reason))
}
