//! Another machine: a network namespace with one cable, whose other end is in the network of the test.

use std::ffi::OsStr;
use std::io::Read;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

/// A machine that is there as long as this value. Its end of the cable is `eth0`.
pub(crate) struct Machine {
    /// Keeps the namespace, until its stdin ends.
    holder: Child,
    number: u8,
}

impl Machine {
    /// The machine with this number: the cable's network is 10.76.NUMBER.0/24, the test is 1 in it and the machine 2.
    pub(crate) fn new(number: u8) -> Machine {
        let mut unshare = Command::new("unshare");
        unshare.args(["--net", "sh", "-c", "ip link set lo up && echo up && exec cat"]);
        let mut holder = unshare.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("unshare runs");
        let mut said = [0; 3];
        let read = holder.stdout.as_mut().map(|out| out.read_exact(&mut said));
        assert!(matches!(read, Some(Ok(()))), "no namespace");
        let machine = Machine { holder, number };
        machine.plug();
        machine
    }

    /// Makes the cable, which is not there.
    fn plug(&self) {
        let (end, pid) = (self.end(), self.holder.id());
        ip(&format!("link add {end} type veth peer name eth0 netns {pid}"));
        ip(&format!("address add {}/24 dev {end}", self.here()));
        ip(&format!("link set {end} up"));
        self.run(&format!("ip address add {}/24 dev eth0", self.there()));
        self.run("ip link set eth0 up");
        self.await_link();
    }

    /// Takes both ends of the cable away, interfaces and all, and makes them anew.
    pub(crate) fn make_cable_anew(&self) {
        ip(&format!("link delete {}", self.end()));
        self.plug();
    }

    /// The name of the test's end of the cable.
    pub(crate) fn end(&self) -> String {
        format!("to{}", self.number)
    }

    /// The address of the test at its end.
    pub(crate) fn here(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 76, self.number, 1)
    }

    /// The address of the machine.
    pub(crate) fn there(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 76, self.number, 2)
    }

    /// Where its network is.
    pub(crate) fn network(&self) -> PathBuf {
        format!("/proc/{}/ns/net", self.holder.id()).into()
    }

    /// Waits until the machine knows that its cable is plugged in: the kernel says so up to a second later.
    fn await_link(&self) {
        let give_up_at = Instant::now() + Duration::from_secs(20);
        let mut show = command_in(&self.network(), "ip");
        show.args(["link", "show", "eth0"]);
        while !show.output().is_ok_and(|it| String::from_utf8_lossy(&it.stdout).contains("state UP")) {
            assert!(Instant::now() < give_up_at, "no link");
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Runs a command there.
    pub(crate) fn run(&self, command: &str) {
        assert!(self.try_run(command), "{command}");
    }

    /// Runs a command there; whether it was done.
    pub(crate) fn try_run(&self, command: &str) -> bool {
        let mut words = command.split(' ');
        let mut there = command_in(&self.network(), words.next().unwrap_or_default());
        there.args(words).status().is_ok_and(|status| status.success())
    }
}

/// `ip` with these arguments.
pub(crate) fn ip(arguments: &str) {
    let done = Command::new("ip").args(arguments.split(' ')).status();
    assert!(done.is_ok_and(|status| status.success()), "ip {arguments}");
}

/// `program`, to be started in this network.
pub(crate) fn command_in(network: &Path, program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("nsenter");
    command.arg(format!("--net={}", network.display())).arg(program);
    command
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.holder.kill();
        let _ = self.holder.wait();
    }
}
