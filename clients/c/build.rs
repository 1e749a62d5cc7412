//! The shared library's name at run time, so that a program in C finds the version that it was linked to. Another first
//! number of a layout or a function is another name.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libscanhub.so.0");
}
