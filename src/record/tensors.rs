//! Safetensors files under a checksum.
//!
//! Such a file is plain safetensors to every other program. Its metadata has `flotilla`, which says what the file is
//! and in which version, and `sha256`, the checksum of the whole file with that checksum's 64 digits set to 0. Files
//! of other programs have neither, and are read without a check; a damaged byte cannot hide both.

use std::collections::BTreeMap;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use safetensors::tensor::{Dtype, Metadata, TensorInfo};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::disk::Disk;
use super::{RecordError, hex};
use crate::file;

/// Most bytes in the header of a file.
pub const MAX_HEADER_BYTES: u64 = 1 << 20;
const KIND: &str = "flotilla";
const CHECKSUM: &str = "sha256";
/// Metadata: the version of the program that wrote the file, where it says so.
pub(super) const VERSION: &str = "version";
const NO_CHECKSUM: &str = "0000000000000000000000000000000000000000000000000000000000000000";

#[cfg(target_endian = "big")]
compile_error!("safetensors hold little-endian numbers, which are read and written in place");

/// A tensor to write: its data in parts, one after another.
pub struct Tensor<'a> {
    /// As the file has it: `weights.0`.
    pub name: String,
    /// What its numbers are.
    pub dtype: Dtype,
    /// The last index moves fastest.
    pub shape: Vec<usize>,
    /// Little-endian; together as long as the shape says.
    pub parts: Vec<&'a [u8]>,
}

impl<'a> Tensor<'a> {
    /// A tensor of f32.
    pub fn floats(name: String, shape: Vec<usize>, parts: impl IntoIterator<Item = &'a [f32]>) -> Tensor<'a> {
        Tensor { name, dtype: Dtype::F32, shape, parts: parts.into_iter().map(bytemuck::cast_slice).collect() }
    }
}

/// Writes a file of a kind ("policies 1"), whole or not at all.
///
/// # Errors
/// What the system says; nothing else was touched then.
pub fn write(
    disk: &Disk,
    path: &Path,
    kind: &str,
    metadata: &BTreeMap<String, String>,
    tensors: &[Tensor<'_>],
) -> io::Result<()> {
    disk.replace(path, |output| put(output, kind, metadata, tensors).map(drop))
}

/// Writes what such a file holds into a stream. Returns its checksum.
///
/// # Errors
/// The stream refuses it.
pub fn put(
    output: &mut dyn Write,
    kind: &str,
    metadata: &BTreeMap<String, String>,
    tensors: &[Tensor<'_>],
) -> io::Result<String> {
    let mut metadata: Map<_, _> = metadata.iter().map(|(key, value)| (key.clone(), json!(value))).collect();
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
    // Tensors start at a multiple of 8.
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

/// A file whose header was read and, where it has a checksum, found whole.
pub struct TensorFile<R> {
    source: BufReader<R>,
    header: Metadata,
    /// Where the tensors start.
    start: u64,
}

impl<R: Read + Seek> TensorFile<R> {
    /// Opens a file and checks it.
    ///
    /// # Errors
    /// What is wrong with the file, in words.
    pub fn open(source: R) -> Result<TensorFile<R>, String> {
        let mut source = BufReader::with_capacity(1 << 16, source);
        let told = |error: io::Error| match error.kind() {
            io::ErrorKind::UnexpectedEof => "it is cut short".to_string(),
            _ => format!("cannot be read: {error}"),
        };
        let size = source.seek(SeekFrom::End(0)).and_then(|size| source.rewind().map(|()| size)).map_err(told)?;
        let mut length = [0; 8];
        source.read_exact(&mut length).map_err(told)?;
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
        source.read_exact(&mut text).map_err(told)?;
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

    /// Compares the checksum.
    fn verify(&mut self, length: [u8; 8], mut header: Vec<u8>) -> Result<(), String> {
        const DAMAGED: &str = "it is damaged: its checksum does not fit";
        let checksum = self.metadata(CHECKSUM).filter(|checksum| checksum.len() == NO_CHECKSUM.len()).ok_or(DAMAGED)?;
        let place = header.windows(checksum.len()).position(|window| window == checksum.as_bytes()).ok_or(DAMAGED)?;
        header[place..place + NO_CHECKSUM.len()].copy_from_slice(NO_CHECKSUM.as_bytes());
        let checksum = checksum.to_string();
        let mut hash = Sha256::new_with_prefix(length).chain_update(&header);
        let mut chunk = vec![0; (1 << 18).min(self.header.data_len())];
        loop {
            match self.source.read(&mut chunk) {
                Ok(0) => break,
                Ok(read) => hash.update(&chunk[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(format!("cannot be read: {error}")),
            }
        }
        if hex(&hash.finalize()) == checksum { Ok(()) } else { Err(DAMAGED.into()) }
    }

    /// The checksum that it carries, which was compared; none in a file of another program.
    pub fn checksum(&self) -> Option<&str> {
        self.metadata(CHECKSUM)
    }

    /// What kind of file it says it is, none for another program's.
    pub fn kind(&self) -> Option<&str> {
        self.metadata(KIND)
    }

    /// What the file says of itself under a key.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.header.metadata().as_ref()?.get(key).map(String::as_str)
    }

    /// A tensor's type and shape.
    pub fn info(&self, name: &str) -> Option<&TensorInfo> {
        self.header.info(name)
    }

    /// The names of all tensors.
    pub fn names(&self) -> Vec<String> {
        self.header.offset_keys()
    }

    /// A tensor's numbers, in so many equal parts.
    ///
    /// # Errors
    /// No such tensor, another type or shape, or no memory for it.
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
        let told = |error: io::Error| format!("cannot be read: {error}");
        self.source.seek(SeekFrom::Start(self.start + start as u64)).map_err(told)?;
        let part = |_| {
            let mut values = Vec::new();
            let refused = |_| format!("there is no memory for the {} bytes of {name}", end - start);
            values.try_reserve_exact(count).map_err(refused)?;
            values.resize(count, T::zeroed());
            self.source.read_exact(bytemuck::cast_slice_mut(&mut values)).map_err(told)?;
            Ok(values)
        };
        (0..parts).map(part).collect()
    }
}

/// Whether the file at a path says that it is of a later format than this program writes: then the version that wrote
/// it, where the file says that. A file that cannot be read is none.
pub fn newer(path: &Path) -> Option<Option<String>> {
    let mut file = file::open(path).ok()?;
    let mut length = [0; 8];
    file.read_exact(&mut length).ok()?;
    let mut header = vec![0; usize::try_from(u64::from_le_bytes(length).min(MAX_HEADER_BYTES)).ok()?];
    file.read_exact(&mut header).ok()?;
    let header: Metadata = serde_json::from_slice(&header).ok()?;
    let metadata = header.metadata().as_ref()?;
    // All formats so far are the first of their kind. A damaged byte can make one look later, but then no checksum fits.
    let (_, format) = metadata.get(KIND)?.rsplit_once(' ')?;
    let later = format.parse::<u64>().ok()? > 1 && open(path).is_ok();
    later.then(|| metadata.get(VERSION).cloned())
}

/// Opens the file at a path.
///
/// # Errors
/// No such file, or what is wrong with it.
pub fn open(path: &Path) -> Result<TensorFile<std::fs::File>, RecordError> {
    let file = file::open(path).map_err(RecordError::read(path))?;
    TensorFile::open(file).map_err(|reason| RecordError::damaged(path, reason))
}
