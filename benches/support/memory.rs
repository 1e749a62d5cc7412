//! What memory a process and its domain take, as the kernel counts it. Refuses to know what it is used for.

use std::collections::BTreeMap;
use std::fs::{read_dir, read_to_string};
use std::os::unix::fs::MetadataExt;

use schema::Domain;

use super::Outcome;

/// Resident memory of a process in bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Resident {
    /// All of it.
    pub(crate) all: f64,
    /// Its heap and stacks.
    pub(crate) own: f64,
    /// Pages of programs and libraries.
    pub(crate) files: f64,
    /// Pages of shared memory that it has touched: consumers' too, as far as they have the same ones.
    pub(crate) shared: f64,
}

impl Resident {
    /// That of `pid`.
    pub(crate) fn of(pid: u32) -> Outcome<Resident> {
        let status = read_to_string(format!("/proc/{pid}/status"))?;
        let field = |name: &str| -> Outcome<f64> {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            let kb =
                line.and_then(|line| line.split_whitespace().next()).ok_or_else(|| format!("no {name}"))?;
            Ok(kb.parse::<f64>()? * 1024.0)
        };
        Ok(Resident {
            all: field("VmRSS:")?,
            own: field("RssAnon:")?,
            files: field("RssFile:")?,
            shared: field("RssShmem:")?,
        })
    }
}

/// Files of `domain` in /dev/shm by the ends of their names, which tell what they are for: how many, and the bytes that
/// they take.
pub(crate) fn segments(domain: &Domain) -> Outcome<BTreeMap<String, (usize, f64)>> {
    let mut kinds = BTreeMap::<String, (usize, f64)>::new();
    for entry in read_dir("/dev/shm")? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !name.starts_with(&domain.prefix()) {
            continue;
        }
        // Who leaves meanwhile takes it along.
        let Ok(metadata) = entry.metadata() else { continue };
        let kind = kinds.entry(name.rsplit('.').next().unwrap_or_default().to_owned()).or_default();
        kind.0 += 1;
        kind.1 += metadata.blocks() as f64 * 512.0;
    }
    Ok(kinds)
}
