//! Tests that run again in a new network namespace, which has only the loopback interface.

use std::process::Command;
use std::sync::OnceLock;

use super::child::succeeds;
use super::{own_program, rerun_test, single_test_args, skip};

/// Variable that is set in the process that runs the test in the namespace.
const NAMESPACE_VARIABLE: &str = "SCANHUB_TEST_NETWORK";

/// Runs `test`, whose name is `name`, in a new network namespace. Skips the test if the system does not allow
/// namespaces.
pub(crate) fn in_a_network(name: &str, test: impl FnOnce()) {
    if std::env::var_os(NAMESPACE_VARIABLE).is_some() {
        return test();
    }
    let mut unshare = Command::new("unshare");
    unshare.arg("--net");
    if !rustix::process::getuid().is_root() {
        unshare.arg("--map-root-user");
    }
    let mut attempt = Command::new("unshare");
    attempt.args(unshare.get_args()).args(["ip", "link", "set", "lo", "up"]);
    static IS_ALLOWED: OnceLock<bool> = OnceLock::new();
    if !*IS_ALLOWED.get_or_init(|| succeeds(attempt)) {
        skip("netns", "this user may not create a network namespace, or `ip` is not installed");
        return;
    }
    let up = "ip link set lo up && exec \"$@\"";
    unshare
        .args(["sh", "-c", up, "sh"])
        .arg(own_program())
        .args(single_test_args(name))
        .env(NAMESPACE_VARIABLE, "1");
    rerun_test(name, unshare);
}
