//! Files as `torch.save` writes them, for tests that need networks of sizes that no golden file has.

use std::io::{Cursor, Write as _};

use ksim_planners::nets::{Tensor, Weights};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// A dict of tensors.
pub(crate) struct StateDict<'a> {
    /// Its name in the file's dict; empty for the file's dict itself.
    pub(crate) under: &'a str,
    /// What stands before the names of its tensors.
    pub(crate) prefix: &'a str,
    /// Its tensors.
    pub(crate) weights: &'a Weights,
}

/// The bytes of a file of dicts.
pub(crate) fn torch_save(dicts: &[StateDict<'_>]) -> Vec<u8> {
    let mut pickle = b"\x80\x02}".to_vec();
    let mut entries: Vec<(String, Vec<u8>)> = Vec::new();
    for dict in dicts {
        if !dict.under.is_empty() {
            pickle.extend(text(dict.under));
            pickle.push(b'}');
        }
        for (name, tensor) in &dict.weights.tensors {
            let key = entries.len().to_string();
            pickle.extend(text(&format!("{}{name}", dict.prefix)));
            pickle.extend(rebuild(&key, tensor));
            pickle.push(b's');
            let bytes = tensor.values.iter().flat_map(|value| value.to_le_bytes());
            entries.push((format!("c/data/{key}"), bytes.collect()));
        }
        if !dict.under.is_empty() {
            pickle.push(b's');
        }
    }
    pickle.push(b'.');
    entries.push(("c/data.pkl".to_owned(), pickle));
    entries.push(("c/version".to_owned(), b"3\n".to_vec()));
    archive(&entries)
}

/// An archive of entries, as name and contents.
pub(crate) fn archive(entries: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, contents) in entries {
        writer
            .start_file(name.as_str(), options)
            .expect("a new entry");
        writer.write_all(contents).expect("memory takes it");
    }
    writer.finish().expect("memory takes it").into_inner()
}

/// The call that makes a contiguous tensor of a storage.
fn rebuild(key: &str, tensor: &Tensor) -> Vec<u8> {
    let mut pickle = b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec();
    pickle.extend(text("storage"));
    pickle.extend(b"ctorch\nFloatStorage\n");
    pickle.extend([text(key), text("cpu"), int(tensor.values.len())].concat());
    pickle.extend(b"tQ");
    pickle.extend(int(0));
    let stride = |at: usize| tensor.shape[at + 1..].iter().product();
    let strides = (0..tensor.shape.len()).map(stride).collect();
    for numbers in [tensor.shape.clone(), strides] {
        pickle.push(b'(');
        numbers.into_iter().for_each(|n| pickle.extend(int(n)));
        pickle.push(b't');
    }
    pickle.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    pickle
}

fn int(n: usize) -> Vec<u8> {
    let n = u32::try_from(n).expect("a small number");
    [&b"J"[..], &n.to_le_bytes()].concat()
}

fn text(text: &str) -> Vec<u8> {
    let length = u32::try_from(text.len()).expect("a short text");
    [&b"X"[..], &length.to_le_bytes(), text.as_bytes()].concat()
}
