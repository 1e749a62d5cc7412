//! Rules for the contents of sources: unsafe code, shared memory, the scanner's EEPROM, and the form of a file.

use super::tree::{SourceTree, code, find};

/// Returns whether `path` is an integration test or a bench. Tests and benches may encode any telegram.
fn is_test(path: &str) -> bool {
    path.starts_with("tests/") || path.starts_with("benches/") || path.contains("/tests/")
}

/// Finds code of the program that reads a clock. Clippy checks this for the crates in `hub/` and `schema/`. It cannot
/// check the program, whose folder contains all crates, including those that may read a clock.
pub(crate) fn only_the_demonstration_of_the_program_reads_clocks(tree: &SourceTree) -> Vec<String> {
    find(tree, &["Instant::now", "SystemTime::now", "clock_gettime"], |path| {
        let in_hub = path.strip_prefix("hub/");
        let is_program = in_hub.is_some_and(|file| {
            !file.contains('/') || file.starts_with("cli/") || file.starts_with("replay/")
        });
        is_program && path != "hub/demo.rs"
    })
}

/// Files that may contain unsafe code. Each of them needs something that no safe crate offers.
const UNSAFE_FILES: [&str; 9] = [
    // A page of memory that the hub and the subscribers map.
    "schema/shm/src/doorbell.rs",
    // The descriptors with which subscribers are woken.
    "schema/shm/src/wake.rs",
    // A query to the kernel whether no process has a file open.
    "schema/shm/src/file_in_use.rs",
    // A handler for SIGBUS.
    "hub/daemon/src/process.rs",
    // The kernel's counters of a UART, and a locked descriptor that is passed to the library for serial lines.
    "hub/port/src/tty.rs",
    // Addresses from programs in C.
    "clients/c/src/ffi.rs",
    // Names of functions that are exported to the linker of programs in C. The file has no unsafe block.
    "clients/c/src/export.rs",
    // A subscription that moves between threads of Python, and views of its samples.
    "clients/python/src/client.rs",
    // An allocator that counts allocations.
    "hub/daemon/tests/counting/mod.rs",
];
/// Maximum number of unsafe blocks in the product. Unsafe blocks of tests and benches must be in listed files, too, but
/// do not count.
const MAX_UNSAFE_BLOCKS: usize = 12;

pub(crate) fn unsafe_code_is_rare_and_explained(tree: &SourceTree) -> Vec<String> {
    let mut breaches =
        find(tree, &["allow(unsafe_code)", "expect(unsafe_code)"], |path| !UNSAFE_FILES.contains(&path));
    let mut blocks = 0;
    for (path, text) in tree.sources() {
        let lines: Vec<&str> = text.lines().collect();
        for (number, line) in code(text) {
            if !["unsafe {", "unsafe impl", "unsafe fn", "unsafe extern"]
                .iter()
                .any(|form| line.contains(form))
            {
                continue;
            }
            blocks += usize::from(!is_test(path));
            let before = &lines[number.saturating_sub(6)..number];
            if !UNSAFE_FILES.contains(&path) || !before.iter().any(|line| line.contains("// SAFETY:")) {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    if blocks > MAX_UNSAFE_BLOCKS {
        breaches.push(format!("{blocks} unsafe blocks"));
    }
    breaches
}

/// Finds code outside of `shm` that uses iceoryx2. Payloads in `schema` may derive one of the traits of iceoryx2.
pub(crate) fn shared_memory_is_built_in_one_crate(tree: &SourceTree) -> Vec<String> {
    // This bench may use iceoryx2, because it needs a service for messages that are longer than any payload.
    let may_build = |path: &str| path.starts_with("schema/shm/src/") || path == "benches/compare/topic.rs";
    let mut places = find(tree, &["iceoryx2::"], |path| !may_build(path));
    let derives =
        |place: &String| place.starts_with("schema/src/") && place.ends_with("prelude::ZeroCopySend;");
    places.retain(|place| !derives(place));
    places
}

/// Finds code in the daemon and the tools that converts raw values to ranges. Only one file may do this conversion,
/// which is between the protocol and the published topics.
pub(crate) fn ranges_are_created_in_one_file(tree: &SourceTree) -> Vec<String> {
    find(tree, &[".words()", "range_array", "upper_array"], |path| {
        path.starts_with("hub/daemon/src/") || path.starts_with("hub/tools/src/")
    })
}

/// Finds code that could write a scanner's EEPROM without a person's consent. Only the module `lms` encodes requests,
/// except those that write the EEPROM. They are encoded in a separate crate, on which most crates do not depend. In the
/// crates that depend on it, only some files may name it. These are the files that ask a person before a request is
/// sent, and those of the simulator, which counts, executes and refuses such requests.
pub(crate) fn only_configure_may_write_the_eeprom(tree: &SourceTree) -> Vec<String> {
    const WRITE_COMMANDS: [&str; 6] = ["0x40", "0x42", "0x46", "0x66", "0x77", "0x7C"];
    const MAY_NAME_COMMANDS: [&str; 3] = ["hub/sim/", "hub/lms-configure/", "hub/tools/src/configure"];
    const MAY_USE_BYTES: [&str; 3] = ["hub/sim/", "hub/drivers/src/lms/", "hub/lms-configure/src/"];
    /// Folder of the code that explains requests and must not encode any.
    const EXPLAIN_FOLDER: &str = "hub/drivers/src/lms/explain";
    let may_name =
        |path: &str| is_test(path) || MAY_NAME_COMMANDS.iter().any(|allowed| path.starts_with(allowed));
    let mut breaches = find(tree, &["Writer::new", "EEPROM_WRITES"], |path| {
        !is_test(path) && !MAY_USE_BYTES.iter().any(|allowed| path.starts_with(allowed))
    });
    breaches.extend(find(tree, &["Writer::new", ".encode("], |path| path.starts_with(EXPLAIN_FOLDER)));
    // Other types whose names end with `Writer` write files and text, so leave them out.
    breaches.retain(|place| {
        let mut writers = place.match_indices("Writer::new");
        !place.contains("Writer::new")
            || writers.any(|(at, _)| !place[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_'))
    });
    let named = ["lms_configure", "eeprom::", "::eeprom", "{eeprom", " eeprom,", " eeprom}"];
    breaches.extend(find(tree, &named, |path| !may_name(path)));
    let lms = |path: &str| path == "hub/drivers/src/lms.rs" || path.starts_with("hub/drivers/src/lms/");
    for (path, text) in tree.sources().filter(|(path, _)| lms(path)) {
        for (number, line) in code(text) {
            let constant = line.split_once(": u8 = ").map(|(_, value)| value.trim_end_matches(';'));
            let writer_arguments = line.split_once("Writer::new(").map(|(_, arguments)| arguments);
            if constant
                .is_some_and(|value| WRITE_COMMANDS.contains(&value) && !path.starts_with(EXPLAIN_FOLDER))
                || writer_arguments
                    .is_some_and(|arguments| WRITE_COMMANDS.iter().any(|command| arguments.contains(command)))
            {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// Finds code that creates a `Consent` outside of the one place that asks a person. Without a `Consent`, no request
/// that writes the EEPROM is sent to a port.
pub(crate) fn only_a_person_confirms_eeprom_writes(tree: &SourceTree) -> Vec<String> {
    const CONSENT_FILE: &str = "hub/tools/src/configure.rs";
    const CONSENT_USER: &str = "hub/lms-configure/src/";
    let mut breaches = find(tree, &["confirmed_by_person", "Consent("], |path| {
        !is_test(path) && path != CONSENT_FILE && !path.starts_with(CONSENT_USER)
    });
    let asks = find(tree, &["confirmed_by_person"], |path| path == CONSENT_FILE);
    let makers = find(tree, &["Consent("], |path| path.starts_with(CONSENT_USER));
    if asks.len() != 1 {
        breaches.push(format!("{CONSENT_FILE} gives consent in {} places", asks.len()));
    }
    // The two places are the type and its only constructor.
    if makers.len() != 2 {
        breaches.push(format!("{CONSENT_USER} makes consent in {} places", makers.len()));
    }
    breaches
}

/// Finds tests that start child processes without the testkit. The testkit ends each of its children with all
/// descendants of the child.
pub(crate) fn tests_start_children_in_one_file(tree: &SourceTree) -> Vec<String> {
    // The first file is the testkit itself. The second file is a program and not a test. The third file starts an
    // example and ends it.
    const ALLOWED: [&str; 3] =
        ["tests/testkit/child.rs", "tests/world/src/main.rs", "clients/client/tests/tokio.rs"];
    let is_checked =
        |path: &str| (path.starts_with("tests/") || path.contains("/tests/")) && !ALLOWED.contains(&path);
    let mut breaches = find(tree, &[".spawn()", ".output()"], is_checked);
    // A call of `.status()` counts only in a file that starts commands, because telegrams and HTTP responses have a
    // status, too.
    breaches.extend(find(tree, &[".status()"], |path| {
        is_checked(path) && tree.text(path).contains("Command::new")
    }));
    breaches
}

/// Tests that may sleep, each with the reason. They simulate a device or a person, run a scenario at real speed, or
/// test a time. All other tests must wait for an event, with `wait_until` or similar functions of the testkits.
const SLEEP_CALLS: [&str; 16] = [
    // Functions that wait for events: those of the testkits, of the browser, and of the tests of the client library,
    // the bridge and the simulator.
    "tests/testkit/",
    "tests/it/browser.rs",
    "clients/client/tests/fake/",
    "clients/bridge/tests/ros2.rs",
    "hub/sim/tests/port/main.rs",
    // Forwards bytes in both directions, as a serial server does.
    "tests/it/serial_server.rs",
    // A scanner that runs at its real speed.
    "tests/it/vendor.rs",
    "hub/daemon/tests/allocation.rs",
    // Actions of a scenario at real speed.
    "tests/it/real_speed/",
    // Programs that send samples at their own rate, until the samples have arrived.
    "clients/verbs/tests/verbs/",
    // Tests of times: the wake-ups in five seconds, a silence, one period, and waits that are canceled.
    "clients/client/tests/descriptor.rs",
    "clients/client/tests/joined.rs",
    "clients/client/tests/silence.rs",
    "clients/client/tests/tokio.rs",
    // Times in which a program may fail, and the time of a silence.
    "tests/it/pages/lines.rs",
    "tests/it/replayed.rs",
];

/// Tests that may compare an elapsed time with a number. Such a test would fail on a busy machine, unless the compared
/// value can only get better there.
const TIME_COMPARISONS: [&str; 4] = [
    // Share of a processor and bytes per second: both are lower on a busy machine.
    "tests/it/flood.rs",
    "tests/it/web_crowd.rs",
    // Wake-ups in three seconds: there are fewer on a busy machine.
    "clients/client/tests/descriptor.rs",
    // Reports how fast the simulation ran.
    "tests/world/src/main.rs",
];

/// Finds tests that wait for a time instead of an event, and tests that require a program to be fast enough.
pub(crate) fn tests_do_not_depend_on_time(tree: &SourceTree) -> Vec<String> {
    let is_of = |path: &str, listed: &[&str]| listed.iter().any(|listed| path.starts_with(listed));
    let is_held =
        |path: &str| is_test(path) && !path.starts_with("benches/") && !path.starts_with("tests/it/tidy");
    let mut breaches =
        find(tree, &["thread::sleep", "sleep(Duration"], |path| is_held(path) && !is_of(path, &SLEEP_CALLS));
    breaches.extend(find(tree, &[".elapsed()"], |path| {
        is_held(path) && !is_of(path, &SLEEP_CALLS) && !is_of(path, &TIME_COMPARISONS)
    }));
    breaches
}

pub(crate) fn files_begin_with_a_description(tree: &SourceTree) -> Vec<String> {
    let described = |text: &str| text.starts_with("//! ");
    let files = tree.files(".rs").filter(|(_, text)| !described(text));
    files.map(|(path, _)| format!("{path} does not begin with a description of the module")).collect()
}

/// Finds names of files and items that contain words without a meaning, such as `util`.
pub(crate) fn names_have_no_vague_words(tree: &SourceTree) -> Vec<String> {
    const EMPTY_NAMES: [&str; 7] = ["manager", "util", "utils", "helper", "helpers", "common", "misc"];
    let empty = |name: &str| {
        let spread: String = name
            .chars()
            .flat_map(|c| if c.is_uppercase() { vec!['_', c.to_ascii_lowercase()] } else { vec![c] })
            .collect();
        spread.split('_').any(|part| EMPTY_NAMES.contains(&part))
    };
    let mut breaches = Vec::new();
    for (path, text) in tree.sources() {
        if path.split(['/', '.']).any(empty) {
            breaches.push(path.to_owned());
        }
        for (number, line) in code(text) {
            let word = |c: char| !c.is_alphanumeric() && c != '_';
            // Leave out text between quotes, because people read it.
            let named = line.split('"').step_by(2).any(|outside| outside.split(word).any(empty));
            if line.contains("fn get_") || named {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// Finds text that presents the project as a safety device. Only README.md may use the word, to explain that the
/// project is not a safety device.
pub(crate) fn no_text_promises_safety(tree: &SourceTree) -> Vec<String> {
    let mut breaches = Vec::new();
    for ending in [".rs", ".md", ".toml", ".service", ".rules", ".run"] {
        for (path, text) in tree.files(ending) {
            if path == "README.md" || path.starts_with("tests/it/tidy") {
                continue;
            }
            for (number, line) in text.lines().enumerate() {
                let line = line.replace("SAFETY:", "").to_lowercase().replace("not a safety device", "");
                if line.contains("safety") || line.contains("protective") {
                    breaches.push(format!("{path}:{}: {}", number + 1, line.trim()));
                }
            }
        }
    }
    breaches
}
