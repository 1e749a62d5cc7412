//! Rules for what a source may contain: unsafe code, shared memory, the scanner's EEPROM, and the shape of a file.

use super::tree::{SourceTree, code, find};

/// Integration tests and benches may do as they like with telegrams.
fn is_test(path: &str) -> bool {
    path.starts_with("tests/") || path.starts_with("benches/") || path.contains("/tests/")
}

/// Finds clocks in the program. Clippy holds this for the crates below `hub/` and `schema/`, but the program has the folder of all
/// crates, also of those that may read a clock.
pub(crate) fn only_the_demonstration_of_the_program_reads_clocks(tree: &SourceTree) -> Vec<String> {
    find(tree, &["Instant::now", "SystemTime::now", "clock_gettime"], |path| {
        let in_hub = path.strip_prefix("hub/");
        let is_program = in_hub.is_some_and(|file| {
            !file.contains('/') || file.starts_with("cli/") || file.starts_with("replay/")
        });
        is_program && path != "hub/demo.rs"
    })
}

/// Files that may hold unsafe code, each for something that no safe crate offers.
const UNSAFE_FILES: [&str; 9] = [
    // A page that hub and consumers map.
    "schema/shm/src/doorbell.rs",
    // The descriptors that wake consumers.
    "schema/shm/src/wake.rs",
    // The kernel's word whether nobody has a file.
    "schema/shm/src/file_in_use.rs",
    // A handler for SIGBUS.
    "hub/daemon/src/process.rs",
    // The kernel's counters of a UART, and a descriptor that is open and locked already, given to the library for serial
    // lines.
    "hub/port/src/tty.rs",
    // Addresses that programs in C bring.
    "clients/c/src/ffi.rs",
    // Names of functions as the linker of such programs looks for them; no block.
    "clients/c/src/export.rs",
    // A subscription that moves between threads of Python, and views of its samples.
    "clients/python/src/client.rs",
    // An allocator that counts.
    "hub/daemon/tests/counting/mod.rs",
];
/// In what is shipped: tests and benches are listed and explained like all, and not counted.
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

/// Services are built in one crate. Payloads in schema derive one trait of the library.
pub(crate) fn shared_memory_is_built_in_one_crate(tree: &SourceTree) -> Vec<String> {
    // Messages longer than any payload are compared with sockets by a service that no topic has.
    let may_build = |path: &str| path.starts_with("schema/shm/src/") || path == "benches/compare/topic.rs";
    let mut places = find(tree, &["iceoryx2::"], |path| !may_build(path));
    let derives =
        |place: &String| place.starts_with("schema/src/") && place.ends_with("prelude::ZeroCopySend;");
    places.retain(|place| !derives(place));
    places
}

/// Words of the wire become ranges in a unit in one file, between the protocol and what consumers see.
pub(crate) fn ranges_are_born_in_one_file(tree: &SourceTree) -> Vec<String> {
    find(tree, &[".words()", "range_array", "upper_array"], |path| {
        path.starts_with("hub/daemon/src/") || path.starts_with("hub/tools/src/")
    })
}

/// Finds code that could write a scanner's EEPROM without a person's consent. Requests are encoded in `lms` and nowhere
/// else. Those that write the EEPROM have their own crate, which most crates do not depend on. In the crates that do, only
/// these files may name it: those that ask a person before a request is sent, and the simulator, which counts, executes and
/// refuses such requests.
pub(crate) fn only_configure_may_write_the_eeprom(tree: &SourceTree) -> Vec<String> {
    const WRITE_COMMANDS: [&str; 6] = ["0x40", "0x42", "0x46", "0x66", "0x77", "0x7C"];
    const MAY_NAME_COMMANDS: [&str; 3] = ["hub/sim/", "hub/lms-configure/", "hub/tools/src/configure"];
    const MAY_USE_BYTES: [&str; 3] = ["hub/sim/", "hub/drivers/src/lms/", "hub/lms-configure/src/"];
    /// Here requests are explained, and none is made.
    const EXPLAIN_FOLDER: &str = "hub/drivers/src/lms/explain";
    let may_name =
        |path: &str| is_test(path) || MAY_NAME_COMMANDS.iter().any(|allowed| path.starts_with(allowed));
    let mut breaches = find(tree, &["Writer::new", "EEPROM_WRITES"], |path| {
        !is_test(path) && !MAY_USE_BYTES.iter().any(|allowed| path.starts_with(allowed))
    });
    breaches.extend(find(tree, &["Writer::new", ".encode("], |path| path.starts_with(EXPLAIN_FOLDER)));
    // Files and lines of text are written too, by writers of longer names.
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

/// Only where a person is asked is consent made, without which nothing that writes the EEPROM leaves for a port.
pub(crate) fn consent_is_given_by_persons(tree: &SourceTree) -> Vec<String> {
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
    // The type and its one constructor.
    if makers.len() != 2 {
        breaches.push(format!("{CONSENT_USER} makes consent in {} places", makers.len()));
    }
    breaches
}

/// Finds tests that start children themselves. The testkit ends its children with all their descendants.
pub(crate) fn tests_start_children_in_one_file(tree: &SourceTree) -> Vec<String> {
    // The second file is a program and not a test. The third one runs an example in its own process and ends it.
    const ALLOWED: [&str; 3] =
        ["tests/testkit/child.rs", "tests/world/src/main.rs", "clients/client/tests/tokio.rs"];
    let is_checked =
        |path: &str| (path.starts_with("tests/") || path.contains("/tests/")) && !ALLOWED.contains(&path);
    let mut breaches = find(tree, &[".spawn()", ".output()"], is_checked);
    // Telegrams and HTTP responses have a status, too.
    breaches.extend(find(tree, &[".status()"], |path| {
        is_checked(path) && tree.text(path).contains("Command::new")
    }));
    breaches
}

/// Tests that sleep: what stands in for a device or a person, or plays a list of actions at real speed. All others wait for an
/// event, by `until` and its like of the test kits. Each says why.
const SLEEP_CALLS: [&str; 16] = [
    // Waits for events: the kits of the programs, of the library, of the simulator and of its other tests.
    "tests/testkit/",
    "tests/it/browser.rs",
    "clients/client/tests/fake/",
    "clients/bridge/tests/ros2.rs",
    "hub/sim/tests/port/main.rs",
    // Carries bytes as a serial server does.
    "tests/it/serial_server.rs",
    // A sensor at its pace.
    "tests/it/vendor.rs",
    "hub/daemon/tests/allocation.rs",
    // Actions at real speed.
    "tests/it/real_speed/",
    // Senders at their pace, until what they send was seen.
    "clients/verbs/tests/verbs/",
    // The statement is about time: wake-ups in five seconds, a silence, one period, waits that are canceled.
    "clients/client/tests/descriptor.rs",
    "clients/client/tests/joined.rs",
    "clients/client/tests/silence.rs",
    "clients/client/tests/tokio.rs",
    // Time in which a program may fail.
    "tests/it/pages/lines.rs",
    "tests/it/replayed.rs",
];

/// Tests that compare a time that passed with a number. They fail on a busy machine, unless the number is one that the
/// program may not fall below.
const TIME_COMPARISONS: [&str; 4] = [
    // Share of a processor, and bytes in a second: a busy machine makes both less.
    "tests/it/flood.rs",
    "tests/it/web_crowd.rs",
    // Wakes in three seconds: a busy machine makes them fewer.
    "clients/client/tests/descriptor.rs",
    // Its report says how fast the world was.
    "tests/world/src/main.rs",
];

/// Tests wait for events, never for a time, and hold no program to a time on a machine that others use too.
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

/// Names that say nothing.
pub(crate) fn names_say_something(tree: &SourceTree) -> Vec<String> {
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
            // What stands between quotes is for people.
            let named = line.split('"').step_by(2).any(|outside| outside.split(word).any(empty));
            if line.contains("fn get_") || named {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// This is no safety device, and nothing may read as if it were one. Only README says what it is not at length.
pub(crate) fn nothing_promises_safety(tree: &SourceTree) -> Vec<String> {
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
