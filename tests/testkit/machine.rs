//! Simulated second machine: a network namespace with one cable (a veth pair) to the network of the test.

use std::ffi::OsStr;
use std::io::Read;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use super::child::{Child, output, spawn, status};

/// Machine that exists until this value is dropped. The machine's end of the cable is the interface `eth0`.
pub(crate) struct Machine {
    /// Process that keeps the namespace alive.
    holder: Child,
    number: u8,
}

impl Machine {
    /// Creates the machine with this number. The cable's network is 10.76.NUMBER.0/24. In this network, the test has
    /// the address 10.76.NUMBER.1 and the machine has 10.76.NUMBER.2.
    pub(crate) fn new(number: u8) -> Machine {
        let mut unshare = Command::new("unshare");
        unshare.args(["--net", "sh", "-c", "ip link set lo up && echo up && exec cat"]);
        let mut holder = spawn(unshare.stdin(Stdio::piped()).stdout(Stdio::piped())).expect("unshare runs");
        let mut buffer = [0; 3];
        let read = holder.stdout.as_mut().map(|out| out.read_exact(&mut buffer));
        assert!(matches!(read, Some(Ok(()))), "cannot create a network namespace");
        let machine = Machine { holder, number };
        machine.plug();
        machine
    }

    /// Creates the cable, which must not exist yet.
    fn plug(&self) {
        let (end, pid) = (self.test_interface(), self.holder.id());
        ip(&format!("link add {end} type veth peer name eth0 netns {pid}"));
        ip(&format!("address add {}/24 dev {end}", self.test_address()));
        ip(&format!("link set {end} up"));
        self.run_command(&format!("ip address add {}/24 dev eth0", self.machine_address()));
        self.run_command("ip link set eth0 up");
        self.wait_for_carrier();
    }

    /// Deletes both interfaces of the cable, and creates new ones.
    pub(crate) fn replace_cable(&self) {
        ip(&format!("link delete {}", self.test_interface()));
        self.plug();
    }

    /// Returns the name of the test's interface.
    pub(crate) fn test_interface(&self) -> String {
        format!("to{}", self.number)
    }

    /// Returns the address of the test on the cable.
    pub(crate) fn test_address(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 76, self.number, 1)
    }

    /// Returns the address of the machine.
    pub(crate) fn machine_address(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 76, self.number, 2)
    }

    /// Returns the path of the file that lists the UDP sockets of the machine.
    pub(crate) fn udp_sockets(&self) -> PathBuf {
        PathBuf::from(format!("/proc/{}/net/udp", self.holder.id()))
    }

    /// Returns the path of the network namespace of the machine.
    pub(crate) fn network(&self) -> PathBuf {
        format!("/proc/{}/ns/net", self.holder.id()).into()
    }

    /// Waits until the machine's interface has a carrier, which the kernel reports up to a second late.
    fn wait_for_carrier(&self) {
        let give_up_at = Instant::now() + Duration::from_secs(20);
        let mut show = command_in(&self.network(), "ip");
        show.args(["link", "show", "eth0"]);
        while !output(&mut show).is_ok_and(|it| String::from_utf8_lossy(&it.stdout).contains("state UP")) {
            assert!(Instant::now() < give_up_at, "timeout: eth0 has no carrier");
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Runs a command on the machine. `command` is a program with its arguments, separated by single spaces.
    ///
    /// # Panics
    ///
    /// Panics if the command fails.
    pub(crate) fn run_command(&self, command: &str) {
        assert!(self.try_run_command(command), "the command failed: {command}");
    }

    /// Runs a command on the machine, and returns whether it succeeded.
    pub(crate) fn try_run_command(&self, command: &str) -> bool {
        let mut words = command.split(' ');
        let mut there = command_in(&self.network(), words.next().unwrap_or_default());
        status(there.args(words)).is_ok_and(|status| status.success())
    }
}

/// Runs `ip` with these arguments, which are separated by single spaces.
///
/// # Panics
///
/// Panics if the command fails.
pub(crate) fn ip(arguments: &str) {
    let done = status(Command::new("ip").args(arguments.split(' ')));
    assert!(done.is_ok_and(|status| status.success()), "the command failed: ip {arguments}");
}

/// Returns a command that starts `program` in the network namespace with the path `network`.
pub(crate) fn command_in(network: &Path, program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("nsenter");
    command.arg(format!("--net={}", network.display())).arg(program);
    command
}
