//! C header for datagrams, compared with the golden datagrams and with `schema`. The tests are skipped if no C compiler
//! is installed.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit::{output, skip};

use super::readers::{self, Reader};

/// Compiles the reader with strict warnings, and with memory checks if the compiler has them. If no C compiler is
/// installed, skips the test and returns `None`.
fn reader() -> Option<PathBuf> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("lan-reader");
    if output(Command::new("cc").arg("--version")).is_err() {
        skip("cc", "there is no C compiler");
        return None;
    }
    let compile = |watch: &[&str]| {
        let mut cc = Command::new("cc");
        cc.args(["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-g"]).args(watch);
        cc.arg("-I")
            .arg(top.join("clients/c"))
            .arg(top.join("tests/it/lan/reader.c"))
            .arg("-o")
            .arg(&program);
        output(cc).expect("a compiler starts")
    };
    if !compile(&["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]).status.success() {
        eprintln!("without a watch over memory: this compiler has none");
        let output = compile(&[]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    Some(program)
}

#[test]
fn header_reads_the_same_datagrams_as_schema() {
    let Some(program) = reader() else { return };
    let mut reader = Reader::start(&mut Command::new(program));
    readers::check_vectors(&mut reader);
    readers::check_keyed_vectors(&mut reader);
    readers::check_damaged(&mut reader, 5_000);
    reader.end();
}
