//! The flags of benches that run within themselves and measure no processes: all of it or a quick look, for people or as lines
//! of JSON. Refuses to know what is measured.

use std::process::ExitCode;

/// Whether `--json` and `--quick` were said.
///
/// # Errors
///
/// The exit code of a usage error, which was told.
pub(crate) fn asked() -> Result<[bool; 2], ExitCode> {
    let mut asked = [false; 2];
    for word in std::env::args().skip(1) {
        match word.as_str() {
            "--json" => asked[0] = true,
            "--quick" => asked[1] = true,
            "--bench" => {}
            other => {
                eprintln!("{other}? --json, --quick");
                return Err(ExitCode::from(2));
            }
        }
    }
    Ok(asked)
}
