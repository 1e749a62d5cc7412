//! A network of a test's own: the test runs again in a new network namespace, in which only the loopback is.

use std::process::Command;
use std::sync::OnceLock;

use super::{only, own_program, run_again, skip};

/// Where the namespace is made: the test that shall run in it.
const INSIDE: &str = "SCANHUB_TEST_NETWORK";

/// Runs `test`, which is called `name`, in a network namespace of its own; says so if the system does not allow that.
pub(crate) fn in_a_network(name: &str, test: impl FnOnce()) {
    if std::env::var_os(INSIDE).is_some() {
        return test();
    }
    let mut unshare = Command::new("unshare");
    unshare.arg("--net");
    if !rustix::process::getuid().is_root() {
        unshare.arg("--map-root-user");
    }
    let mut attempt = Command::new("unshare");
    attempt.args(unshare.get_args()).args(["ip", "link", "set", "lo", "up"]);
    static ALLOWED: OnceLock<bool> = OnceLock::new();
    let succeeds = || attempt.output().is_ok_and(|output| output.status.success());
    if !*ALLOWED.get_or_init(succeeds) {
        skip("netns", "this user may not make a network namespace, or there is no `ip`");
        return;
    }
    let up = "ip link set lo up && exec \"$@\"";
    unshare.args(["sh", "-c", up, "sh"]).arg(own_program()).args(only(name)).env(INSIDE, "1");
    run_again(name, unshare);
}
