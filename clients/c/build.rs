//! Build script that sets the shared library's name at run time (soname), so that a C program finds the version to
//! which it was linked. An incompatible change of a layout or a function requires another name.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libscanhub.so.0");
}
