//! An example of a page as a program, built in the way in which a reader of the page would build it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use super::blocks::Block;
use crate::client_c::installed::InstalledLibrary;
use crate::testkit::{TestEnv, client_python, output, python};

/// An example that is ready to run.
pub(crate) struct Example {
    /// Page and line of the block.
    pub(crate) location: String,
    /// Text of the block.
    pub(crate) text: String,
    program: PathBuf,
    arguments: Vec<PathBuf>,
}

impl Example {
    /// Builds `block` in `env`. Returns `None`, and prints the reason, if this machine lacks a tool that it needs.
    ///
    /// # Errors
    ///
    /// Returns the message of the compiler if the compiler rejects the block.
    pub(crate) fn build(block: &Block, env: &TestEnv) -> Result<Option<Example>, String> {
        let name = block.location.replace(['/', '.', ':'], "_");
        let source = |ending: &str, text: &str| PathBuf::from(env.file(&format!("{name}.{ending}"), text));
        let program = match block.language.as_str() {
            "python" => return Ok(python_example(block, &source("py", &block.text))),
            "rust" => Some(compile_rust(&source("rs", &with_main(block)), env)?),
            "c" => compile_c(&source("c", &with_main(block)), env)?,
            "cpp" => compile_cpp(&source("cpp", &with_main(block)), env)?,
            other => return Err(format!("{}: {other} is not a programming language", block.location)),
        };
        let (location, text) = (block.location.clone(), block.text.clone());
        Ok(program.map(|program| Example { location, text, program, arguments: Vec::new() }))
    }

    /// Returns the command that runs the example in `env` with the hub of `env`.
    pub(crate) fn command(&self, env: &TestEnv) -> Command {
        let mut command = Command::new(&self.program);
        // Python warnings are errors, except for the warning that a hub is still starting.
        command.args(&self.arguments).current_dir(env.path("")).env_remove("XDG_RUNTIME_DIR");
        command.env("SCANHUB_DOMAIN", env.domain().name()).env("PYTHONWARNINGS", "error,default:nothing yet");
        command.env("RUNTIME_DIRECTORY", env.domain().root().parent().expect("a parent directory"));
        command.env("PYTHONUNBUFFERED", "1").env("PYTHONDONTWRITEBYTECODE", "1");
        command
    }
}

/// Returns the text of `block`. If the text has no main function, it is put into one.
fn with_main(block: &Block) -> String {
    let Block { language, text, .. } = block;
    match language.as_str() {
        "rust" if !text.contains("fn main") => {
            format!("fn main() -> Result<(), scanhub_client::Error> {{\n{text}}}\n")
        }
        "c" if !text.contains("int main") => {
            format!("{C_PRELUDE}int main(void)\n{{\n{LINE_BUFFERING}{text}return 0;\n}}\n")
        }
        "cpp" if !text.contains("int main") => {
            format!("{CPP_PRELUDE}int main()\n{{\n{LINE_BUFFERING}{text}}}\n")
        }
        _ => text.clone(),
    }
}

fn python_example(block: &Block, source: &Path) -> Option<Example> {
    let python = match &block.text {
        text if text.contains("rosbags") => python("rosbags"),
        text if text.contains("mcap") => python("mcap, mcap_ros2"),
        _ => client_python(),
    }?;
    let (location, text) = (block.location.clone(), block.text.clone());
    let program = PathBuf::from(python.get_program());
    Some(Example { location, text, program, arguments: vec![source.to_owned()] })
}

fn compile_c(source: &Path, env: &TestEnv) -> Result<Option<PathBuf>, String> {
    InstalledLibrary::installed().map(|installed| installed.try_compile(env, source, &[])).transpose()
}

fn compile_cpp(source: &Path, env: &TestEnv) -> Result<Option<PathBuf>, String> {
    InstalledLibrary::installed().and_then(|installed| installed.try_compile_cpp(env, source)).transpose()
}

/// Compiles `source` with `rustc` and the library that Cargo builds.
fn compile_rust(source: &Path, env: &TestEnv) -> Result<PathBuf, String> {
    let program = env.path(&format!("{}-rust", source.file_stem().expect("a name").display()));
    let mut command = Command::new(std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    command.args(["--edition=2024", "-Dwarnings", "-o"]).arg(&program).arg(source);
    let library = library();
    let directory = library.parent().expect("a directory");
    command.arg(format!("-Ldependency={}", directory.join("deps").display()));
    command.arg(format!("--extern={LIBRARY_NAME}={}", library.display()));
    let output = output(command).expect("a compiler");
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned());
    }
    Ok(program)
}

/// Name of the crate that clients in Rust use.
const LIBRARY_NAME: &str = "scanhub_client";

/// Builds the client library, once per process, and returns its path. Cargo builds only this library, because it must
/// not rebuild this test or the program while they run.
fn library() -> &'static Path {
    static LIBRARY_PATH: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY_PATH.get_or_init(build_library)
}

fn build_library() -> PathBuf {
    let mut command = Command::new(env!("CARGO"));
    command.args(["build", "--offline", "--message-format=json", "--quiet", "--lib"]);
    command.arg("--package=scanhub-client");
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    let output = output(command.current_dir(env!("CARGO_MANIFEST_DIR"))).expect("Cargo");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let messages = String::from_utf8(output.stdout).expect("text");
    let messages = messages.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let library = |message: Value| {
        let files = message["filenames"].as_array()?;
        let library = files.iter().filter_map(Value::as_str).find(|file| file.ends_with(".rlib"))?;
        (message["target"]["name"] == LIBRARY_NAME).then(|| fs::canonicalize(library).expect("a file"))
    };
    let libraries: Vec<_> = messages.filter_map(library).collect();
    let [library] = &libraries[..] else { panic!("{libraries:?}") };
    library.clone()
}

/// Text that precedes each C example that is only a part of a program.
const C_PRELUDE: &str = "#include <errno.h>\n#include <poll.h>\n#include <scanhub/attach.h>\n#include <stdio.h>\n#include <unistd.h>\n";
const CPP_PRELUDE: &str = "#include <cmath>\n#include <cstdio>\n#include <scanhub/attach.hpp>\n";
/// Statement with which a C program writes its output line by line, so that the test can read each line at once.
const LINE_BUFFERING: &str = "setvbuf(stdout, NULL, _IOLBF, BUFSIZ);\n";
