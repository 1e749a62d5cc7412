//! Window of tmux in which a test runs a program. Tmux is an independent implementation of a terminal, so its window
//! shows whether the program's output is right. The tmux server has its socket in the directory of the test, and ends
//! with the test.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use super::child::{Child, output, spawn, succeeds};
use super::{TestEnv, WAIT_TIMEOUT, skip};

/// Session with one window.
pub(crate) struct Tmux {
    socket: PathBuf,
    /// Command that created the session. The tmux server is a descendant of this command.
    _session: Child,
}

impl Tmux {
    /// Runs `line` in a shell, in a window with this number of columns and rows. If tmux is not installed, skips the
    /// test and returns `None`.
    pub(crate) fn start(env: &TestEnv, line: &str, (columns, rows): (u16, u16)) -> Option<Tmux> {
        if !succeeds(Command::new("tmux").arg("-V")) {
            skip("tmux", "it is not installed (Debian: apt-get install tmux)");
            return None;
        }
        let socket = env.path("tmux");
        let (columns, rows) = (columns.to_string(), rows.to_string());
        let words = ["-f", "/dev/null", "new-session", "-d", "-x", &columns, "-y", &rows, line];
        let mut begin = command(&socket, &words);
        let mut session = spawn(begin.stdin(Stdio::null()).stdout(Stdio::null())).expect("tmux starts");
        assert!(session.wait().is_ok_and(|status| status.success()), "tmux {words:?}");
        Some(Tmux { socket, _session: session })
    }

    /// Sends `keys`, which are the names that tmux has for keys, to the program.
    pub(crate) fn press(&self, keys: &[&str]) {
        self.run_tmux(&[&["send-keys"], keys].concat());
    }

    /// Sets the size of the window in columns and rows.
    pub(crate) fn resize(&self, (columns, rows): (u16, u16)) {
        self.run_tmux(&["resize-window", "-x", &columns.to_string(), "-y", &rows.to_string()]);
    }

    /// Waits until `is_expected` accepts the rows of the window, and returns the rows.
    pub(crate) fn await_rows(
        &self,
        description: &str,
        is_expected: impl Fn(&[String]) -> bool,
    ) -> Vec<String> {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        loop {
            let rows = self.rows();
            if is_expected(&rows) {
                return rows;
            }
            assert!(
                Instant::now() < give_up_at,
                "timeout: the window does not show {description}:\n{}",
                rows.join("\n")
            );
            thread::sleep(Duration::from_millis(50));
        }
    }

    fn rows(&self) -> Vec<String> {
        let output = self.run_tmux(&["capture-pane", "-p"]);
        String::from_utf8_lossy(&output.stdout).lines().map(str::to_owned).collect()
    }

    fn run_tmux(&self, words: &[&str]) -> Output {
        let output =
            output(command(&self.socket, words)).unwrap_or_else(|error| panic!("tmux {words:?}: {error}"));
        assert!(output.status.success(), "tmux {words:?}: {}", String::from_utf8_lossy(&output.stderr));
        output
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        let _ = output(command(&self.socket, &["kill-server"]));
    }
}

fn command(socket: &Path, words: &[&str]) -> Command {
    let mut command = Command::new("tmux");
    // Use UTF-8 in every locale, and never the tmux server of the person who runs the test.
    command.arg("-u").arg("-S").arg(socket).args(words);
    command.env_remove("TMUX").env_remove("NO_COLOR");
    command
}
