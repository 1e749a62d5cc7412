//! Which machine this is, to tell it from one whose disk is a copy. Refuses to know what for.

use std::path::Path;

use scanhub_files::regular;

/// A number for this machine: of its own alone, and always the same (machine-id(5), which is not to be handed on as it is).
/// Nothing where the file at `path` is missing or is no such id.
pub(super) fn machine(path: &Path) -> Option<u64> {
    let text = regular::read_text(path, regular::LONGEST).ok()?;
    let id = text.trim_end();
    let is_id = id.len() == 32 && id.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_id.then(|| hash(id))
}

/// Where Linux keeps it.
pub(super) const ID: &str = "/etc/machine-id";

/// FNV-1a: the same in every build, as it is compared with what an earlier one wrote.
fn hash(id: &str) -> u64 {
    let bytes = "scanhub gateway ".bytes().chain(id.bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_is_always_the_same_number() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("machine-id");
        let of = |text: &str| {
            std::fs::write(&path, text).unwrap();
            machine(&path)
        };
        let id = "0123456789abcdef0123456789abcdef";
        assert_eq!(
            (of(id), of(&format!("{id}\n"))),
            (Some(0x8f5c_2224_2b82_b25b), Some(0x8f5c_2224_2b82_b25b))
        );
        assert_ne!(of("0123456789abcdef0123456789abcdee\n"), of(id));
        assert!(
            ["", "uninitialized\n", "x123456789abcdef0123456789abcdef\n"].iter().all(|no| of(no).is_none())
        );
        std::fs::remove_file(&path).unwrap();
        assert_eq!(machine(&path), None);
    }
}
