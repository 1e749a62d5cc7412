//! Another machine: a network namespace with one cable, whose other end is in the network of the test.

use std::ffi::OsStr;
use std::io::Read;
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use super::ip;

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
        let (end, pid) = (machine.end(), machine.holder.id());
        ip(&format!("link add {end} type veth peer name eth0 netns {pid}"));
        ip(&format!("address add {}/24 dev {end}", machine.here()));
        ip(&format!("link set {end} up"));
        machine.run(&format!("ip address add {}/24 dev eth0", machine.there()));
        machine.run("ip link set eth0 up");
        machine
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

/// `program`, to be started in this network.
pub(crate) fn command_in(network: &std::path::Path, program: impl AsRef<OsStr>) -> Command {
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
