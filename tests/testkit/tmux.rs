//! A window of tmux, a terminal that other people wrote: what stands in it is what it made of the program's output. A server
//! of its own, on a socket in the test's directory, gone with the test.

use std::path::PathBuf;
use std::process::{Command, Output};
use std::thread;
use std::time::{Duration, Instant};

use super::{PATIENCE, TestEnv, skip};

/// A session with one window.
pub(crate) struct Tmux {
    socket: PathBuf,
}

impl Tmux {
    /// Runs the shell's `line` in a window of `size`, columns and rows; nothing, and why, where there is no tmux.
    pub(crate) fn start(env: &TestEnv, line: &str, (columns, rows): (u16, u16)) -> Option<Tmux> {
        if Command::new("tmux").arg("-V").output().is_err() {
            skip("tmux", "there is none (Debian: apt-get install tmux)");
            return None;
        }
        let tmux = Tmux { socket: env.path("tmux") };
        let (columns, rows) = (columns.to_string(), rows.to_string());
        tmux.tell(&["-f", "/dev/null", "new-session", "-d", "-x", &columns, "-y", &rows, line]);
        Some(tmux)
    }

    /// Types keys, as tmux calls them.
    pub(crate) fn press(&self, keys: &[&str]) {
        self.tell(&[&["send-keys"], keys].concat());
    }

    /// Makes the window so large.
    pub(crate) fn resize(&self, (columns, rows): (u16, u16)) {
        self.tell(&["resize-window", "-x", &columns.to_string(), "-y", &rows.to_string()]);
    }

    /// Waits until the rows of the window are as `wanted`, and returns them.
    pub(crate) fn await_rows(&self, what: &str, wanted: impl Fn(&[String]) -> bool) -> Vec<String> {
        let give_up_at = Instant::now() + PATIENCE;
        loop {
            let rows = self.rows();
            if wanted(&rows) {
                return rows;
            }
            assert!(Instant::now() < give_up_at, "no {what}:\n{}", rows.join("\n"));
            thread::sleep(Duration::from_millis(50));
        }
    }

    fn rows(&self) -> Vec<String> {
        let output = self.tell(&["capture-pane", "-p"]);
        String::from_utf8_lossy(&output.stdout).lines().map(str::to_owned).collect()
    }

    fn tell(&self, words: &[&str]) -> Output {
        let output = self.command(words).output().unwrap_or_else(|error| panic!("tmux {words:?}: {error}"));
        assert!(output.status.success(), "tmux {words:?}: {}", String::from_utf8_lossy(&output.stderr));
        output
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = Command::new("tmux");
        // UTF-8, whatever the locale; not the server of whoever runs the test.
        command.arg("-u").arg("-S").arg(&self.socket).args(words);
        command.env_remove("TMUX").env_remove("NO_COLOR");
        command
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        let _ = self.command(&["kill-server"]).output();
    }
}
