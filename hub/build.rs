//! Build script that links the functions that run for each telegram next to each other, so that they occupy fewer pages
//! of memory.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=hub/build.rs");
    println!("cargo::rerun-if-changed=hub/path.lds");
    println!("cargo::rerun-if-env-changed=MOLD_PATH");
    println!("cargo::rerun-if-env-changed=SCANHUB_LINK_ORDER");
    let variable = |name| env::var(name).unwrap_or_default();
    // The linkers of GNU and LLVM understand the script. `mold -run` takes their place and sets MOLD_PATH.
    let linker = variable("RUSTC_LINKER") + &variable("CARGO_ENCODED_RUSTFLAGS");
    let is_other = ["mold", "gold", "wild"].iter().any(|name| linker.contains(name))
        || env::var_os("MOLD_PATH").is_some()
        || variable("SCANHUB_LINK_ORDER") == "0";
    if variable("CARGO_CFG_TARGET_OS") == "linux" && variable("PROFILE") == "release" && !is_other {
        println!("cargo::rustc-link-arg-bins=-T{}/hub/path.lds", variable("CARGO_MANIFEST_DIR"));
    }
}
