//! Child processes of tests: starts them, and ends each one together with all its descendants.
//!
//! A child runs in a separate process group, so that dropping its [`Child`] also ends the processes that it has
//! started, such as a browser that a shell script started without `exec`. A descendant may leave the group, as a daemon
//! or a program in a new session does. Two environment variables therefore mark all descendants: [`RUN_VARIABLE`] names
//! the test binary, and [`CHILD_VARIABLE`] names the child.

#![allow(clippy::disallowed_methods, reason = "limits of real time; crates of the hub use this file, too")]
#![allow(dead_code)] // Each user of this file needs only a part of it.

use std::borrow::BorrowMut;
use std::fs;
use std::io::{self, Read, Write};
use std::ops::{Deref, DerefMut};
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitStatus, Output, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{
    Pid, Signal, WaitId, WaitIdOptions, geteuid, kill_process, kill_process_group, waitid,
};

/// Variable with the target directory, process ID and start time of the test binary, separated by colons. `.ci/run`
/// also searches the environments of processes for this variable.
const RUN_VARIABLE: &str = "SCANHUB_TEST_RUN";
/// Variable that names the child from which a process descends: the process ID and start time of the test binary and an
/// index, separated by dots. If a test runs again in another process, that process appends a slash and the name of its
/// child to the value.
const CHILD_VARIABLE: &str = "SCANHUB_TEST_CHILD";
/// Variable that `.ci/run` sets to a time in clock ticks since boot. If a test binary started at this time or later,
/// the processes that it left are not ended here, because `.ci/run` itself checks for them.
const SINCE_VARIABLE: &str = "SCANHUB_TEST_SINCE";

/// Time that a program has to exit after the signal TERM, before it is killed.
const TERM_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time from killing processes until the kernel has ended them, even on a busy machine.
const KILL_TIMEOUT: Duration = Duration::from_secs(60);
/// Maximum time for which a process has an empty environment while it loads its program. The limit is short, because
/// the environment of some processes stays empty.
const EXEC_TIMEOUT: Duration = Duration::from_millis(200);
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// A child process of a test. Dropping it ends the child and all its descendants, and waits for their end.
pub(crate) struct Child {
    process: std::process::Child,
    /// Value of [`CHILD_VARIABLE`] in the environment of the child.
    mark: String,
}

/// Starts `command` in a new process group.
///
/// The caller must set the stdin of `command`. The child must not read from the terminal of the person who runs the
/// tests, because the child is not in that terminal's foreground.
///
/// # Errors
///
/// Returns an error if the program cannot be started.
pub(crate) fn spawn(mut command: impl BorrowMut<Command>) -> io::Result<Child> {
    static NEXT_CHILD: AtomicU32 = AtomicU32::new(0);
    static ONCE: OnceLock<()> = OnceLock::new();
    ONCE.get_or_init(end_earlier_runs);
    let own = std::process::id();
    let started = start_time(own as i32).unwrap_or_default();
    let mark = format!("{own}.{started}.{}", NEXT_CHILD.fetch_add(1, Ordering::Relaxed));
    let mark = std::env::var(CHILD_VARIABLE).map_or(mark.clone(), |outer| format!("{outer}/{mark}"));
    let command = command.borrow_mut();
    command.env(RUN_VARIABLE, run()).env(CHILD_VARIABLE, &mark);
    // `setsid` itself creates a session and a group with its own process ID. If it already led a group, it would fork.
    if command.get_program() != "setsid" {
        command.process_group(0);
    }
    Ok(Child { process: command.spawn()?, mark })
}

/// Runs `command` to its end with an empty stdin, and returns its output.
///
/// # Errors
///
/// Returns an error if the program cannot be started or its output cannot be read.
pub(crate) fn output(mut command: impl BorrowMut<Command>) -> io::Result<Output> {
    let command = command.borrow_mut();
    spawn(command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()))?.wait_with_output()
}

/// Runs `command` to its end with an empty stdin, and returns its exit status. The program inherits stdout and stderr
/// of the test unless `command` sets them.
///
/// # Errors
///
/// Returns an error if the program cannot be started.
pub(crate) fn status(mut command: impl BorrowMut<Command>) -> io::Result<ExitStatus> {
    spawn(command.borrow_mut().stdin(Stdio::null()))?.wait()
}

/// Returns whether `command` can be started and succeeds. Discards its output.
pub(crate) fn succeeds(command: impl BorrowMut<Command>) -> bool {
    output(command).is_ok_and(|output| output.status.success())
}

/// Writes an executable file, for example a shell script. The test may start the file at once.
///
/// A child process writes the file. If this process did, another thread could fork a child that inherits the open
/// file, and the kernel refuses to execute a file that any process has open for writing ("Text file busy").
///
/// # Panics
///
/// Panics if the file cannot be written.
pub(crate) fn write_program(path: impl AsRef<Path>, content: impl AsRef<[u8]>) {
    let path = path.as_ref();
    let mut shell = Command::new("sh");
    shell.args(["-c", "cat > \"$0\" && chmod 755 \"$0\""]).arg(path);
    let mut shell = spawn(shell.stdin(Stdio::piped())).expect("sh starts");
    let written = shell.stdin.take().map(|mut stdin| stdin.write_all(content.as_ref()));
    let status = shell.wait();
    assert!(
        written.is_some_and(|it| it.is_ok()) && status.is_ok_and(|it| it.success()),
        "cannot write {}",
        path.display()
    );
}

impl Child {
    /// Sends a signal to the program, but not to its descendants.
    ///
    /// # Errors
    ///
    /// Returns an error if the exit status of the program was read before, because another process may have its ID by
    /// now.
    pub(crate) fn signal(&self, signal: Signal) -> rustix::io::Result<()> {
        self.has_ended()?;
        kill_process(Pid::from_child(&self.process), signal)
    }

    /// Returns whether the program has ended, without reading its exit status.
    ///
    /// # Errors
    ///
    /// Returns an error if the exit status was read before.
    fn has_ended(&self) -> rustix::io::Result<bool> {
        let flags = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        Ok(waitid(WaitId::Pid(Pid::from_child(&self.process)), flags)?.is_some())
    }

    /// Closes stdin and waits for the end of the program. Returns its exit status and the output of the pipes that the
    /// test has not taken.
    ///
    /// # Errors
    ///
    /// Returns an error if a pipe cannot be read.
    pub(crate) fn wait_with_output(mut self) -> io::Result<Output> {
        drop(self.stdin.take());
        let errors = self.stderr.take();
        let errors = thread::spawn(|| read_all(errors));
        let stdout = read_all(self.stdout.take())?;
        let stderr = errors.join().expect("the thread that reads stderr does not panic")?;
        Ok(Output { status: self.wait()?, stdout, stderr })
    }

    /// Ends the program and all its descendants, and waits for their end.
    pub(crate) fn end(&mut self) {
        let id = Pid::from_child(&self.process);
        // The kernel does not reuse the ID of the process, which is also that of its group, until the process is
        // reaped.
        let is_reaped = self.has_ended().is_err();
        if !is_reaped {
            // Send TERM first, so that the program can end its children and remove its files.
            let _ = kill_process(id, Signal::TERM);
            let give_up_at = Instant::now() + TERM_TIMEOUT;
            while self.has_ended() == Ok(false) && Instant::now() < give_up_at {
                thread::sleep(POLL_INTERVAL);
            }
            let _ = kill_process(id, Signal::KILL);
            let _ = kill_process_group(id, Signal::KILL);
        }
        end_all(|| self.living_pids(!is_reaped));
        if !is_reaped {
            let _ = self.process.wait();
        }
    }

    /// Returns the command lines of the running descendants, and of the child itself if it is running.
    pub(crate) fn living_command_lines(&self) -> Vec<String> {
        let text = |pid| fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let line = |pid| String::from_utf8_lossy(&text(pid)).trim_end_matches('\0').replace('\0', " ");
        self.living_pids(false).into_iter().map(line).collect()
    }

    /// Returns the process IDs of the running descendants, and of the child itself if it is running. Members of the
    /// child's process group count as descendants if `is_group_ours` is true.
    fn living_pids(&self, is_group_ours: bool) -> Vec<i32> {
        let id = self.process.id() as i32;
        // The kernel assigns ascending process IDs until it reaches the maximum, and then starts again from low
        // numbers. Unless that has happened since the child started, its descendants have higher IDs than the child.
        let lowest = if newest_process_id().is_some_and(|newest| newest >= id) { id } else { 1 };
        let is_marked = |pid: &i32| {
            let mark = variable(*pid, CHILD_VARIABLE).unwrap_or_default();
            mark.strip_prefix(&self.mark).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        };
        let is_in_group = |pid: &i32| is_group_ours && group(*pid) == Some(id);
        process_ids().filter(|pid| *pid >= lowest && (is_marked(pid) || is_in_group(pid))).collect()
    }
}

impl Deref for Child {
    type Target = std::process::Child;

    fn deref(&self) -> &std::process::Child {
        &self.process
    }
}

impl DerefMut for Child {
    fn deref_mut(&mut self) -> &mut std::process::Child {
        &mut self.process
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.end();
    }
}

/// Reads all bytes of a pipe. Returns no bytes if `pipe` is `None`.
fn read_all(pipe: Option<impl Read>) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    pipe.map_or(Ok(0), |mut pipe| pipe.read_to_end(&mut bytes))?;
    Ok(bytes)
}

/// Kills the processes that `living` returns, and repeats this until it returns none.
///
/// # Panics
///
/// Panics if processes still run after [`KILL_TIMEOUT`].
fn end_all(living: impl Fn() -> Vec<i32>) {
    let give_up_at = Instant::now() + KILL_TIMEOUT;
    loop {
        let pids = living();
        if pids.is_empty() {
            return;
        }
        pids.iter().filter_map(|pid| Pid::from_raw(*pid)).for_each(|pid| {
            let _ = kill_process(pid, Signal::KILL);
        });
        if Instant::now() > give_up_at {
            // A panic while another one unwinds would abort the test binary.
            assert!(thread::panicking(), "killed processes still run: {pids:?}");
            return;
        }
        thread::sleep(POLL_INTERVAL);
    }
}

/// Ends the processes that interrupted test runs of this target directory left.
fn end_earlier_runs() {
    let since = std::env::var(SINCE_VARIABLE).ok().and_then(|text| text.parse().ok()).unwrap_or(u64::MAX);
    end_runs_of(run().rsplitn(3, ':').nth(2).unwrap_or_default(), since);
}

/// Ends processes of this user that a test binary of the target directory `target` left. Only test binaries count that
/// started before `since` (clock ticks since boot) and have ended.
pub(crate) fn end_runs_of(target: &str, since: u64) {
    let user = geteuid().as_raw();
    let is_left = |pid: &i32| {
        let is_of_user = fs::metadata(format!("/proc/{pid}")).is_ok_and(|it| it.uid() == user);
        let run = if is_of_user { variable(*pid, RUN_VARIABLE) } else { None };
        run.is_some_and(|run| has_ended_before(&run, target, since))
    };
    end_all(|| process_ids().filter(is_left).collect());
}

/// Returns whether the value `run` of [`RUN_VARIABLE`] names a test binary of `target` that started before `since` and
/// has ended.
fn has_ended_before(run: &str, target: &str, since: u64) -> bool {
    let [start, pid, directory] = run.rsplitn(3, ':').collect::<Vec<_>>()[..] else { return false };
    let (Ok(start), Ok(pid)) = (start.parse::<u64>(), pid.parse()) else { return false };
    directory == target && start < since && start_time(pid) != Some(start)
}

/// Returns the value of [`RUN_VARIABLE`] for the children of this process.
fn run() -> &'static str {
    static RUN_VARIABLE: OnceLock<String> = OnceLock::new();
    RUN_VARIABLE.get_or_init(|| {
        let program = std::env::current_exe().unwrap_or_default();
        // Cargo passes this variable, a directory in the target directory, to integration tests only. Binaries of unit
        // tests are in target/debug/deps.
        let target = option_env!("CARGO_TARGET_TMPDIR").map(Path::new).and_then(Path::parent);
        let target = target.or(program.ancestors().nth(3)).unwrap_or(Path::new("/"));
        let own = std::process::id();
        format!("{}:{own}:{}", target.display(), start_time(own as i32).unwrap_or_default())
    })
}

/// Returns the IDs of all processes.
fn process_ids() -> impl Iterator<Item = i32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

/// Returns the process ID that the kernel assigned most recently.
fn newest_process_id() -> Option<i32> {
    fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().last()?.parse().ok()
}

/// Returns the value of variable `name` in the environment with which the process `pid` was started.
fn variable(pid: i32, name: &str) -> Option<String> {
    let mut environment = environment(pid)?;
    let give_up_at = Instant::now() + EXEC_TIMEOUT;
    // The environment of a process is empty for a short time while the process starts another program.
    while environment.is_empty() && has_environment(pid) && Instant::now() < give_up_at {
        thread::sleep(Duration::from_millis(1));
        environment = self::environment(pid)?;
    }
    let mut lines = environment.split(|byte| *byte == 0);
    let value = lines.find_map(|line| line.strip_prefix(name.as_bytes())?.strip_prefix(b"="))?;
    Some(String::from_utf8_lossy(value).into_owned())
}

/// Returns the first 256 kB of the environment of a process. The result is empty if the process starts another program
/// between `open` and `read`. A single call of `read` is used, because several calls could return only a part of the
/// environment.
fn environment(pid: i32) -> Option<Vec<u8>> {
    let mut bytes = vec![0; 1 << 18];
    let len = fs::File::open(format!("/proc/{pid}/environ")).ok()?.read(&mut bytes).ok()?;
    bytes.truncate(len);
    Some(bytes)
}

/// Returns whether a process has an environment, or will have one as soon as its program is loaded.
fn has_environment(pid: i32) -> bool {
    let Some(fields) = stat(pid) else { return false };
    let field =
        |number: usize| fields.get(number - 3).and_then(|field| field.parse::<u64>().ok()).unwrap_or(0);
    let (flags, start, end) = (field(9), field(50), field(51));
    flags & PF_KTHREAD == 0 && (end == 0 || start != end)
}

/// Flag of a kernel thread, which never has an environment (linux/sched.h).
const PF_KTHREAD: u64 = 0x0020_0000;

/// Returns the process group of the process `pid`, or `None` if the process has ended.
fn group(pid: i32) -> Option<i32> {
    stat(pid)?.get(2)?.parse().ok()
}

/// Returns the start time of a process in clock ticks since boot, or `None` if the process does not exist or has ended.
fn start_time(pid: i32) -> Option<u64> {
    stat(pid)?.get(19)?.parse().ok()
}

/// Returns the fields of `/proc/PID/stat` (see proc_pid_stat(5)) from the third one on, or `None` if the process has
/// ended.
fn stat(pid: i32) -> Option<Vec<String>> {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The second field is the name in brackets, which may contain spaces and brackets.
    let (_, fields) = text.rsplit_once(')')?;
    let fields: Vec<_> = fields.split_whitespace().map(str::to_owned).collect();
    // A zombie has ended, but its parent has not read its exit status yet.
    fields.first().is_some_and(|state| !["Z", "X"].contains(&state.as_str())).then_some(fields)
}
