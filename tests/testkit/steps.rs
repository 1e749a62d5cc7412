//! Tracer that single-steps a thread of another process by ptrace, and counts the instructions and system calls of each
//! telegram. `benches/path` and `tests/it/path_cost.rs` use it.
//!
//! The cost of a telegram covers all steps between two sleeps. The first sleep is the one after the previous telegram
//! was published. The second one is the first sleep after a doorbell has rung for this telegram. Single steps take so
//! long that the thread may fall behind the line. [`Stepper::run_past_telegram`] then runs the thread until telegrams
//! arrive in time again.
#![allow(dead_code)] // The test uses only a part of this module.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::ops::Range;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::ptrace;
use nix::sys::signal::Signal;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;

/// Thread under ptrace. Only the thread that called [`Stepper::attach`] can step the traced thread. The traced thread
/// runs freely again after [`Stepper::detach`].
pub(crate) struct Stepper {
    thread: Pid,
    /// Kind of each instruction that was executed, by its address.
    kinds: HashMap<u64, InstructionKind>,
    /// Functions that were called since the first step and have not returned, outermost first.
    calls: Vec<Call>,
    /// Number of the system call that the thread has entered, after [`Stepper::run_past_telegram`].
    entered: Option<u64>,
    /// Number of bytes that were read for the next telegram. It is negative if an earlier telegram was counted before
    /// all of its bytes were read.
    read: i64,
    /// Whether a doorbell has rung for the next telegram.
    has_rung: bool,
    /// Number (not count) of the system call that the thread made last.
    last_call: u64,
}

/// Function call that has not returned.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Call {
    /// Address of the function's first instruction.
    pub(crate) function: u64,
    /// Address on the stack at which the return address is stored.
    frame: u64,
}

/// Cost of a telegram, without repeated waits. At 9,600 baud, a telegram takes 0.7 s to arrive, and the hub interrupts
/// its wait every 50 ms to check for requests. These extra waits do not count. At the usual 500,000 baud, the hub waits
/// once per telegram.
#[derive(Clone, Debug, Default)]
pub(crate) struct TelegramCost {
    /// Number of telegrams that the cost covers. It is more than 1 if the next telegram was complete before the thread
    /// read the first one.
    pub(crate) telegrams: u64,
    pub(crate) instructions: u64,
    /// Number of system calls, by the number of the call.
    pub(crate) system_calls: BTreeMap<u64, u64>,
    /// Ranges of step indexes that are repeated waits. Each range goes from one sleep to the next one, without another
    /// system call in between.
    pub(crate) repeats: Vec<Range<u64>>,
    /// Time from the last read of the telegram to the end of its steps. The thread falls behind the line by this time.
    pub(crate) lag: Duration,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum InstructionKind {
    SystemCall,
    Call,
    Other,
}

/// Length in bytes of a telegram with 361 beams.
const TELEGRAM_LEN: i64 = 732;
/// Result register of a system call that has not returned: `-ENOSYS`.
const NOT_RETURNED: u64 = -38_i64 as u64;

/// Timeout for a telegram. It is long, because on a busy machine the steps of a telegram take minutes. It only ends a
/// test that hangs.
const TELEGRAM_TIMEOUT: Duration = Duration::from_secs(900);

/// Number of the system call `read` on x86-64.
const READ_CALL: u64 = 0;
/// Number of the system call `futex` on x86-64.
const FUTEX_CALL: u64 = 202;
/// Numbers of the system calls in which a thread of the hub sleeps: poll, nanosleep, clock_nanosleep, ppoll.
const SLEEP_CALLS: [u64; 4] = [7, 35, 230, 271];
/// Operations of `futex` that ring a doorbell: FUTEX_WAKE and FUTEX_WAKE_BITSET.
const WAKE_OPERATIONS: [u64; 2] = [1, 10];

impl Stepper {
    /// Attaches to the thread with the ID `thread`, and stops it.
    ///
    /// # Errors
    ///
    /// Returns the reason if this process may not trace the thread.
    pub(crate) fn attach(thread: i32) -> Result<Stepper, String> {
        let thread = Pid::from_raw(thread);
        let refused = |error: Errno| format!("ptrace is not allowed: {error}");
        ptrace::seize(thread, ptrace::Options::PTRACE_O_TRACESYSGOOD).map_err(refused)?;
        ptrace::interrupt(thread).map_err(refused)?;
        let mut stepper = Stepper {
            thread,
            kinds: HashMap::new(),
            calls: Vec::new(),
            entered: None,
            read: 0,
            has_rung: false,
            last_call: 0,
        };
        stepper.wait()?;
        Ok(stepper)
    }

    /// Runs the thread until it has waited for a telegram, has published that telegram, and sleeps again. `interval` is
    /// the time between two telegrams.
    pub(crate) fn run_past_telegram(&mut self, interval: Duration) -> Result<(), String> {
        loop {
            let started = Instant::now();
            self.run_telegram()?;
            if started.elapsed() > interval / 2 {
                self.read = 0;
                return Ok(());
            }
        }
    }

    /// Runs the thread until the end of a telegram, and counts its system calls. Unlike single steps, counting hardly
    /// delays the thread, so the thread makes the same calls as without tracing.
    pub(crate) fn run_telegram(&mut self) -> Result<TelegramCost, String> {
        self.calls.clear();
        let (started, mut signal) = (Instant::now(), None);
        let mut cost = TelegramCost::default();
        if let Some(call) = self.entered.take() {
            cost.system_calls.insert(call, 1);
        }
        loop {
            check_timeout(started)?;
            ptrace::syscall(self.thread, signal).map_err(trace_error)?;
            signal = self.wait()?;
            let registers = ptrace::getregs(self.thread).map_err(trace_error)?;
            if signal.is_some() {
                continue;
            }
            let call = registers.orig_rax;
            if registers.rax == NOT_RETURNED {
                cost.telegrams = self.enter_call(call, registers.rsi);
                if cost.telegrams > 0 {
                    self.entered = Some(call);
                    return Ok(cost);
                }
                *cost.system_calls.entry(call).or_default() += 1;
            } else {
                self.leave_call(call, registers.rax);
            }
        }
    }

    /// Runs the thread through one telegram in single steps. Calls `on_step` before each instruction with three
    /// arguments: the address of the instruction, the functions in which it runs (outermost first), and the number of
    /// the system call that it makes, if any.
    pub(crate) fn step_telegram(
        &mut self,
        mut on_step: impl FnMut(u64, &[Call], Option<u64>),
    ) -> Result<TelegramCost, String> {
        let mut cost = TelegramCost::default();
        let started = Instant::now();
        let mut last_read = started;
        // Index of the next step, and index of the first step after the last sleep.
        let (mut index, mut slept) = (0, 0);
        if let Some(call) = self.entered.take() {
            *cost.system_calls.entry(call).or_default() += 1;
            self.last_call = call;
            self.step()?;
        }
        loop {
            let registers = ptrace::getregs(self.thread).map_err(trace_error)?;
            let address = registers.rip;
            while self.calls.last().is_some_and(|call| call.frame < registers.rsp) {
                self.calls.pop();
            }
            let kind = self.kind(address)?;
            let call = (kind == InstructionKind::SystemCall).then_some(registers.rax);
            if let Some(call) = call {
                cost.telegrams = self.enter_call(call, registers.rsi);
                if cost.telegrams > 0 {
                    let repeated: u64 = cost.repeats.iter().map(|steps| steps.end - steps.start).sum();
                    cost.instructions = index - repeated;
                    cost.lag = last_read.elapsed();
                    return Ok(cost);
                }
                let is_sleep = SLEEP_CALLS.contains(&call);
                if is_sleep && index > 0 && SLEEP_CALLS.contains(&self.last_call) {
                    cost.repeats.push(slept..index);
                } else {
                    *cost.system_calls.entry(call).or_default() += 1;
                }
                if is_sleep {
                    check_timeout(started)?;
                    slept = index;
                }
                self.last_call = call;
            }
            on_step(address, &self.calls, call);
            index += 1;
            self.step()?;
            if kind == InstructionKind::Other {
                continue;
            }
            let registers = ptrace::getregs(self.thread).map_err(trace_error)?;
            if let Some(call) = call {
                self.leave_call(call, registers.rax);
                if call == READ_CALL {
                    last_read = Instant::now();
                }
            } else {
                self.calls.push(Call { function: registers.rip, frame: registers.rsp });
            }
        }
    }

    /// Ends the tracing. The thread continues to run.
    pub(crate) fn detach(self) {
        // The process may have exited.
        let _ = ptrace::detach(self.thread, None);
    }

    /// Handles the start of a system call. Returns the number of telegrams whose cost ends before this call, or 0 if no
    /// telegram ends.
    fn enter_call(&mut self, call: u64, operation: u64) -> u64 {
        if call == FUTEX_CALL && WAKE_OPERATIONS.contains(&(operation & 0x7f)) {
            self.has_rung = true;
        }
        // The thread may already have read a part of the next telegram, so the quotient is rounded.
        let telegrams = (self.read + TELEGRAM_LEN / 2) / TELEGRAM_LEN;
        if !SLEEP_CALLS.contains(&call) || !self.has_rung || telegrams < 1 {
            return 0;
        }
        self.has_rung = false;
        self.read -= telegrams * TELEGRAM_LEN;
        telegrams.unsigned_abs()
    }

    /// Handles the end of a system call.
    fn leave_call(&mut self, call: u64, result: u64) {
        if call == READ_CALL {
            // A negative result is an error code, not a number of bytes.
            self.read += (result as i64).max(0);
        }
    }

    /// Executes one instruction. Delivers signals that arrive before the instruction.
    fn step(&mut self) -> Result<(), String> {
        let mut signal = None;
        loop {
            ptrace::step(self.thread, signal).map_err(trace_error)?;
            signal = self.wait()?;
            if signal.is_none() {
                return Ok(());
            }
        }
    }

    /// Waits until the thread stops. Returns the signal that stopped it, or `None` if ptrace stopped it.
    fn wait(&mut self) -> Result<Option<Signal>, String> {
        match waitpid(self.thread, Some(WaitPidFlag::__WALL)).map_err(trace_error)? {
            WaitStatus::Stopped(_, Signal::SIGTRAP)
            | WaitStatus::PtraceSyscall(_)
            | WaitStatus::PtraceEvent(..) => Ok(None),
            WaitStatus::Stopped(_, signal) => Ok(Some(signal)),
            ended => Err(format!("the thread has ended: {ended:?}")),
        }
    }

    /// Returns the kind of the instruction at `address`.
    fn kind(&mut self, address: u64) -> Result<InstructionKind, String> {
        if let Some(&kind) = self.kinds.get(&address) {
            return Ok(kind);
        }
        let word = ptrace::read(self.thread, address as ptrace::AddressType).map_err(trace_error)?;
        let kind = match word.to_le_bytes() {
            [0x0f, 0x05, ..] => InstructionKind::SystemCall,
            // `call rel32`, and `call r/m64` with and without a prefix.
            [0xe8, ..] => InstructionKind::Call,
            [0xff, form, ..] | [0x40..=0x4f, 0xff, form, ..] if form >> 3 & 7 == 2 => InstructionKind::Call,
            _ => InstructionKind::Other,
        };
        self.kinds.insert(address, kind);
        Ok(kind)
    }
}

/// Returns an error if more than [`TELEGRAM_TIMEOUT`] has passed since `started`.
fn check_timeout(started: Instant) -> Result<(), String> {
    if started.elapsed() > TELEGRAM_TIMEOUT { Err("no telegram was published".to_owned()) } else { Ok(()) }
}

/// Returns the ID of the thread that runs the link of `sensor` in the hub with the process ID `pid`. The thread has the
/// name of the sensor.
///
/// # Errors
///
/// Returns a message if the hub has no such thread, or has exited.
pub(crate) fn link_thread(pid: u32, sensor: &str) -> Result<i32, String> {
    let failed = |error: std::io::Error| format!("process {pid}: {error}");
    for task in fs::read_dir(format!("/proc/{pid}/task")).map_err(failed)? {
        let task = task.map_err(failed)?;
        let name = fs::read_to_string(task.path().join("comm")).map_err(failed)?;
        if name.trim() == sensor {
            let thread = task.file_name().to_string_lossy().parse();
            return thread.map_err(|_| format!("process {pid}: a thread ID is not a number"));
        }
    }
    Err(format!("process {pid} has no thread {sensor}"))
}

fn trace_error(error: Errno) -> String {
    format!("the thread is lost: {error}")
}
