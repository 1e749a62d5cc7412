//! The C library, installed as users install it, and each way in which users build programs with the library.
#![allow(dead_code)] // Each test binary uses only a part of this module.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use crate::testkit::{TestEnv, output, skip};

/// Prefix with the installed library and its header.
pub(crate) struct InstalledLibrary {
    pub(crate) prefix: PathBuf,
    /// Directory from which the library was installed.
    pub(crate) library: PathBuf,
    /// Output of the script that installed the library.
    pub(crate) messages: String,
}

/// Flags for strict warnings.
const STRICT_FLAGS: [&str; 5] = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"];

impl InstalledLibrary {
    /// Installs the library once for all tests. Skips the test and returns `None` if there is no C compiler.
    pub(crate) fn installed() -> Option<&'static InstalledLibrary> {
        static INSTALLED: OnceLock<InstalledLibrary> = OnceLock::new();
        if !is_installed("cc") {
            return None;
        }
        Some(INSTALLED.get_or_init(|| {
            let here = Path::new(env!("CARGO_TARGET_TMPDIR")).join("client_c");
            let _ = std::fs::remove_dir_all(&here);
            let (prefix, library) = (here.join("prefix"), here.join("library"));
            std::fs::create_dir_all(&library).expect("a directory");
            // Leave out the static library, which takes 100 MB.
            let shared = "libscanhub.so";
            std::os::unix::fs::symlink(build_directory().join(shared), library.join(shared))
                .expect("the link can be created");
            let mut command = Command::new(repository().join("clients/c/install.sh"));
            command.arg("--prefix").arg(&prefix).arg("--library").arg(&library).env_remove("DESTDIR");
            let messages = output(command).expect("a shell starts");
            let messages = stdout_if_success(&messages).unwrap_or_else(|errors| panic!("{errors}"));
            InstalledLibrary { prefix, library, messages }
        }))
    }

    /// Compiles `source` with the shared library, and returns the path of the program.
    pub(crate) fn compile(&self, env: &TestEnv, source: &Path, flags: &[&str]) -> PathBuf {
        self.try_compile(env, source, flags).unwrap_or_else(|message| panic!("{message}"))
    }

    /// Compiles like [`compile`](Self::compile), but returns the compiler's messages if it fails.
    pub(crate) fn try_compile(
        &self,
        env: &TestEnv,
        source: &Path,
        flags: &[&str],
    ) -> Result<PathBuf, String> {
        let words = ["-std=c99", "-D_DEFAULT_SOURCE", "-g", "-pthread"];
        self.build("cc", env, source, &[&words, flags].concat(), &self.shared())
    }

    /// Compiles `source` as C++11, and returns the path of the program. Skips the test and returns `None` if there is
    /// no C++ compiler.
    pub(crate) fn compile_cpp(&self, env: &TestEnv, source: &Path) -> Option<PathBuf> {
        let built = self.try_compile_cpp(env, source)?;
        Some(built.unwrap_or_else(|message| panic!("{message}")))
    }

    /// Compiles `source` as C++20, and returns the path of the program. Skips the test and returns `None` if there is
    /// no C++ compiler.
    pub(crate) fn compile_cpp20(&self, env: &TestEnv, source: &Path) -> Option<PathBuf> {
        let built =
            is_installed("c++").then(|| self.build("c++", env, source, &["-std=c++20"], &self.shared()))?;
        Some(built.unwrap_or_else(|errors| panic!("{errors}")))
    }

    /// Compiles like [`compile_cpp`](Self::compile_cpp), but returns the compiler's messages if it fails.
    pub(crate) fn try_compile_cpp(&self, env: &TestEnv, source: &Path) -> Option<Result<PathBuf, String>> {
        is_installed("c++").then(|| self.build("c++", env, source, &["-std=c++11"], &self.shared()))
    }

    /// Compiles `source` with the static library, and returns the path of the program. Skips the test and returns
    /// `None` if there is no pkg-config.
    pub(crate) fn compile_static(&self, env: &TestEnv, source: &Path) -> Option<PathBuf> {
        let mut ask = self.with_packages(Command::new("pkg-config"));
        let Ok(pkg_config) = output(ask.args(["--static", "--libs-only-l", "scanhub"])) else {
            skip("pkg-config", "it is not installed, so the flags for the static library are unknown");
            return None;
        };
        let flags = stdout_if_success(&pkg_config).unwrap_or_else(|message| panic!("{message}"));
        let mut libraries = vec![build_directory().join("libscanhub.a").display().to_string()];
        libraries.extend(flags.split_whitespace().filter(|word| *word != "-lscanhub").map(str::to_owned));
        let program = self.build("cc", env, source, &["-std=c99"], &libraries);
        Some(program.unwrap_or_else(|message| panic!("{message}")))
    }

    /// Builds the project `source` with CMake, once for each way in which CMake can find the package of the C library.
    /// Returns the build directories, or an empty list if a tool is missing.
    pub(crate) fn cmake(&self, env: &TestEnv, source: &Path) -> Vec<PathBuf> {
        if !["cmake", "c++"].into_iter().all(is_installed) {
            return Vec::new();
        }
        // After the installed files have been moved, a package that contains the path of its old prefix would not work.
        let moved = env.path("moved");
        let mut copy = Command::new("cp");
        copy.arg("-a").arg(&self.prefix).arg(&moved);
        stdout_if_success(&output(copy).expect("cp starts")).unwrap_or_else(|errors| panic!("{errors}"));
        let sources = vec![
            format!("-Dscanhub_DIR={}", repository().join("clients/c/cmake").display()),
            format!("-Dscanhub_LIBRARY_DIR={}", build_directory().display()),
        ];
        let ways =
            [("prefix", vec![format!("-DCMAKE_PREFIX_PATH={}", moved.display())]), ("sources", sources)];
        let build_in = |(name, flags): (&str, Vec<String>)| {
            let build = env.path(&format!("cmake-{name}"));
            let mut configure = Command::new("cmake");
            configure.arg("-S").arg(source).arg("-B").arg(&build).args(flags);
            for command in [&mut configure, Command::new("cmake").arg("--build").arg(&build)] {
                stdout_if_success(&output(command).expect("CMake"))
                    .unwrap_or_else(|errors| panic!("{errors}"));
            }
            build
        };
        ways.map(build_in).into()
    }

    /// Compiles `source` with the flags of pkg-config, and returns the path of the program. Skips the test and returns
    /// `None` if there is no pkg-config.
    pub(crate) fn compile_with_pkg_config(&self, env: &TestEnv, source: &Path) -> Option<PathBuf> {
        let is_missing = || skip("pkg-config", "it is not installed");
        let flags =
            output(self.with_packages(Command::new("pkg-config")).args(["--cflags", "--libs", "scanhub"]));
        let flags = flags.inspect_err(|_| is_missing()).ok()?;
        let flags = stdout_if_success(&flags).unwrap_or_else(|errors| panic!("{errors}"));
        let mut flags: Vec<String> = flags.split_whitespace().map(str::to_owned).collect();
        flags.extend(self.shared().pop());
        Some(self.build("cc", env, source, &["-std=c99"], &flags).unwrap_or_else(|errors| panic!("{errors}")))
    }

    fn build<S: AsRef<OsStr>>(
        &self,
        compiler: &str,
        env: &TestEnv,
        source: &Path,
        flags: &[&str],
        libraries: &[S],
    ) -> Result<PathBuf, String> {
        let name = source.file_stem().expect("a file");
        let program = env.path(&format!("{}-{}", name.display(), flags.concat().len() + libraries.len()));
        let mut command = Command::new(compiler);
        command.args(STRICT_FLAGS).args(flags).arg("-I").arg(self.prefix.join("include")).arg(source);
        command.args(libraries).arg("-o").arg(&program);
        stdout_if_success(&output(command).expect("a compiler starts")).map(|_| program)
    }

    fn shared(&self) -> Vec<String> {
        let library = self.prefix.join("lib").display().to_string();
        vec![format!("-L{library}"), "-lscanhub".to_owned(), format!("-Wl,-rpath,{library}")]
    }

    fn with_packages(&self, mut command: Command) -> Command {
        command.env("PKG_CONFIG_PATH", self.prefix.join("lib/pkgconfig"));
        command
    }
}

/// Returns whether the tool `name` is installed. Skips the test if the tool is missing.
pub(crate) fn is_installed(name: &str) -> bool {
    let found = output(Command::new(name).arg("--version")).is_ok();
    if !found {
        skip(name, "it is not installed");
    }
    found
}

/// Returns the path of the C program `name` of these tests.
pub(crate) fn source(name: &str) -> PathBuf {
    repository().join("tests/it/client_c").join(name)
}

/// Returns the directory of the header in the source tree.
pub(crate) fn header_directory() -> PathBuf {
    repository().join("clients/c/include")
}

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the directory in which Cargo builds the library for this test, next to the test binary.
fn build_directory() -> PathBuf {
    let own = std::env::current_exe().expect("the path of this test");
    own.parent().expect("a directory").to_owned()
}

fn stdout_if_success(output: &Output) -> Result<String, String> {
    let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
    match output.status.success() {
        true => Ok(text(&output.stdout)),
        false => Err(text(&output.stdout) + &text(&output.stderr)),
    }
}
