//! Gateway on a network with faults: interfaces that are removed and created again, full queues, and invalid options.
//! Each test has its own network namespace.

use std::net::Ipv4Addr;
use std::process::{Command, Stdio};

use crate::testkit::{
    Outcome, Program, Receiver, TERM, TestEnv, USR1, decode_datagram, in_a_network, ip, is_class, number,
    skip, spawn, succeeds, wait_until,
};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pipe::fcntl_setpipe_size;
use scanhub_network::lan::{GatewayTable, StreamCounters};
use scanhub_schema::datagram::{Announce, Datagram};
use scanhub_schema::{Background, Topic};
use serde_json::Value;

const STREAM_FLAGS: [&str; 2] = ["--seed=62", "--baud=500000"];
const OWN_ADDRESS: Ipv4Addr = Ipv4Addr::new(10, 76, 0, 1);

/// Creates the interface `ours` with a cable (a veth pair) to the interface `theirs`.
fn create_interface() {
    ip("link add ours type veth peer name theirs");
    ip("addr add 10.76.0.1/24 dev ours");
    ip("link set ours up");
    ip("link set theirs up");
}

/// Waits until the gateway reports that a destination has this state.
fn await_state(gateway: &mut Program, state: &str) -> Value {
    gateway.await_line(state, |line| line["class"] == "lan_link" && line["state"] == state)
}

/// Waits until the counter `key` of topic `scan` has increased by more than 3.
fn await_growth(gateway: &mut Program, key: &str) {
    let mut current = || {
        gateway.signal(USR1);
        number(&gateway.await_line("the statistics", |it| it["class"] == "lan" && it["topic"] == "scan"), key)
    };
    let now = current();
    wait_until(key, || current() > now + 3);
}

/// Returns the sequence number at which the counters of `row` start. This is the number of the first datagram, or the
/// next number in an announcement that arrived earlier.
fn first_sequence(received: &[Vec<u8>], row: &StreamCounters) -> u64 {
    let found = received.iter().find_map(|bytes| {
        let Datagram { head, payload, .. } = decode_datagram(bytes);
        if head.sensor != row.sensor {
            return None;
        }
        if head.topic == row.topic {
            return Some(head.sequence);
        }
        let announce = Announce::unpack(payload).filter(|_| head.topic == Announce::NUMBER)?;
        let next = announce.topics().iter().find(|topic| topic.topic == row.topic)?.next;
        Some(next)
    });
    u64::from(found.expect("a datagram of the row was received"))
}

/// Asserts that the gateway used each sequence number from [`first_sequence`] on once. The received and the lost
/// datagrams together must be as many as the gateway sent or counted as failed.
fn check_gap_free(received: &[Vec<u8>], outcome: &Outcome) {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let mut table = Box::new(GatewayTable::new(&Topic::ALL));
    received.iter().for_each(|bytes| assert!(table.receive(bytes, 1, 0).is_ok()));
    let lines = outcome.of_class("lan");
    for row in table.rows() {
        let topic = Topic::of_number(row.topic).map_or("announce", Topic::name);
        let line = lines.iter().rfind(|line| line["topic"] == topic).expect("its account");
        let numbered = number(line, "sent") + number(line, "send_failed");
        assert_eq!(first_sequence(received, row) + row.received + row.lost(), numbered, "{line}");
    }
}

#[test]
fn gateway_survives_link_down_and_up() {
    in_a_network("gateway_network::gateway_survives_link_down_and_up", || {
        let env = TestEnv::new();
        create_interface();
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let mut gateway = env.gateway(&["--interface=ours", "--to=10.76.0.9:22200"]);
        let receiver = Receiver::new(OWN_ADDRESS);
        receiver.wait_for_datagrams(10, |datagram| datagram.head.topic == Topic::Scan.number());
        await_growth(&mut gateway, "sent");
        // In turn, unplug the cable, switch the interface off, and remove its address. After this loop, another
        // interface gets the same name.
        for (away, back) in [
            ("link set theirs down", "link set theirs up"),
            ("link set ours down", "link set ours up"),
            ("addr flush dev ours", "addr add 10.76.0.1/24 dev ours"),
        ] {
            ip(away);
            let down = await_state(&mut gateway, "down");
            assert_eq!(down["to"], "ours");
            await_growth(&mut gateway, "send_failed");
            ip(back);
            await_state(&mut gateway, "up");
            await_growth(&mut gateway, "sent");
        }
        let mut received = receiver.finish();
        ip("link del ours");
        await_state(&mut gateway, "down");
        await_growth(&mut gateway, "send_failed");
        create_interface();
        await_state(&mut gateway, "up");
        await_growth(&mut gateway, "sent");
        // Membership in a group ends with the interface, so the receiver must join the groups again on the new
        // interface.
        let again = Receiver::new(OWN_ADDRESS);
        again.wait_for_datagrams(10, |datagram| datagram.head.topic == Topic::Scan.number());
        let outcome = gateway.end(TERM);
        received.extend(again.finish());
        check_gap_free(&received, &outcome);
    });
}

#[test]
fn datagrams_dropped_by_a_full_queue_are_counted() {
    in_a_network("gateway_network::datagrams_dropped_by_a_full_queue_are_counted", || {
        let env = TestEnv::new();
        create_interface();
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let mut gateway = env.gateway(&["--interface=ours"]);
        let receiver = Receiver::new(OWN_ADDRESS);
        receiver.wait_for_datagrams(10, |datagram| datagram.head.topic == Topic::Scan.number());
        let limit = "qdisc add dev ours root tbf rate 64kbit burst 2000 limit 4000";
        if !succeeds(Command::new("tc").args(limit.split(' '))) {
            skip("tc", "the kernel cannot limit a queue");
            return;
        }
        let failing = await_state(&mut gateway, "failing");
        assert_eq!(failing["to"], "ours");
        await_growth(&mut gateway, "send_failed");
        assert!(succeeds(Command::new("tc").args(["qdisc", "del", "dev", "ours", "root"])));
        await_state(&mut gateway, "recovered");
        await_growth(&mut gateway, "sent");
        let outcome = gateway.end(TERM);
        check_gap_free(&receiver.finish(), &outcome);
    });
}

#[test]
fn unread_output_does_not_delay_the_gateway() {
    in_a_network("gateway_network::unread_output_does_not_delay_the_gateway", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(Ipv4Addr::LOCALHOST);
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        // The pipe for the gateway's stdout stays open, but nothing reads from it, so it is soon full.
        let (_reader, writer) = std::io::pipe().expect("a pipe");
        fcntl_setpipe_size(&writer, 8192).expect("the pipe can be made smaller");
        let mut command = env.command(&["gateway", "--json", "--no-system-config", "--interface=lo"]);
        command.stdout(writer.try_clone().expect("the pipe can be duplicated")).stdin(Stdio::null());
        let mut gateway = spawn(command).expect("a gateway");
        let signal = |signal| gateway.signal(signal).expect("the gateway runs");
        let is_scan =
            |datagram: &scanhub_schema::datagram::Datagram<'_>| datagram.head.topic == Topic::Scan.number();
        receiver.wait_for_datagrams(3, is_scan);
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        wait_until("the pipe is full", || {
            signal(USR1);
            poll(&mut [PollFd::new(&writer, PollFlags::OUT)], Some(&now)) == Ok(0)
        });
        // Wait for the announcements of several seconds. The gateway sends them although it cannot write its
        // statistics.
        let is_announce =
            |datagram: &scanhub_schema::datagram::Datagram<'_>| datagram.head.topic == Announce::NUMBER;
        receiver.wait_for_datagrams(3, is_announce);
        signal(USR1);
        receiver.wait_for_datagrams(30, is_scan);
        signal(TERM);
        let mut status = None;
        wait_until("the gateway exits", || {
            status = gateway.try_wait().expect("a child");
            status.is_some()
        });
        assert_eq!(status.and_then(|status| status.code()), Some(0));
    });
}

#[test]
fn prints_statistics_on_sigusr1() {
    in_a_network("gateway_network::prints_statistics_on_sigusr1", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(Ipv4Addr::LOCALHOST);
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let flags = ["--interface=lo", "--topic=front/background", "--background-every=1s"];
        let words = [&["gateway", "--no-system-config"], &flags[..]].concat();
        let mut gateway = env.start(&words);
        gateway.wait_for_text("gateway ");
        let is_background = |datagram: &scanhub_schema::datagram::Datagram<'_>| {
            datagram.head.topic == Topic::Background.number()
        };
        receiver.wait_for_datagrams(3, is_background);
        gateway.signal(USR1);
        gateway.wait_for_text("front/background: ");
        gateway.wait_for_text("to lo: ");
        // The gateway sends a new background at once, between the repetitions of the old one.
        let generation = |bytes: &[u8]| {
            let datagram = decode_datagram(bytes);
            let is_one = is_background(&datagram);
            let model = is_one.then(|| Background::read(datagram.payload).expect("a model"))?;
            Some(model.generation)
        };
        assert_eq!(env.run(&["background", "front", "reset"]).exit_code, Some(0));
        wait_until("another generation is sent", || {
            let mut all: Vec<_> = receiver.datagrams().iter().filter_map(|bytes| generation(bytes)).collect();
            all.dedup();
            all.len() > 1
        });
        let outcome = gateway.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let text = String::from_utf8_lossy(&outcome.stdout);
        assert_eq!(text.lines().filter(|line| line.starts_with("to lo: ")).count(), 2, "{text}");
        for bytes in receiver.finish() {
            let topic = decode_datagram(&bytes).head.topic;
            assert!([Announce::NUMBER, Topic::Background.number()].contains(&topic), "{topic}");
        }
    });
}

#[test]
fn rejects_impossible_settings_with_a_hint() {
    in_a_network("gateway_network::rejects_impossible_settings_with_a_hint", || {
        let env = TestEnv::new();
        let _hub = env.hub(&[env.link("front")]);
        let config = |text: &str| format!("--config={}", env.file("gateway.toml", text));
        let refused = |flags: &[&str], code: i32, message_part: &str, hint: &str| {
            let outcome = env.start_gateway(flags).wait();
            let error = outcome.of_class("error").pop().unwrap_or_else(|| panic!("{flags:?}: {outcome}"));
            assert_eq!(outcome.exit_code, Some(code), "{flags:?}: {outcome}");
            let (message, found) = (error["message"].to_string(), error["hint"].to_string());
            assert!(message.contains(message_part) && found.contains(hint), "{flags:?}: {error}");
        };
        refused(&[], 78, "no interface is named", "lo (127.0.0.1, this machine only)");
        refused(&["--interface=eth7"], 78, "eth7", "lo");
        refused(&["--interface=lo", "--to=127.0.0.1"], 78, "127.0.0.1", "HOST:PORT");
        refused(&["--interface=lo", "--to=239.255.76.80:22200"], 78, "not a host", "single hosts");
        refused(&["--interface=lo", "--to=no-such-host.invalid:22200"], 78, "no-such-host", "HOST:PORT");
        let twice = ["--interface=lo", "--to=127.0.0.1:22200", "--to=localhost:22200"];
        refused(&twice, 78, "localhost:22200: it is named twice", "127.0.0.1:22200");
        refused(&["--interface=lo", "--to=127.0.0.1:65500", "--bare"], 78, "port", "65280");
        refused(&["--interface=lo", "--topic=front/scam"], 2, "front/scam", "front/scan");
        refused(&["--interface=lo", "--topic=side/scan"], 3, "side", "front");
        refused(&["--interface=lo", "--topic=front/scan:every=0"], 2, "every=0", "every=4");
        refused(&["--interface=lo", "--topic=front/scan", "--bare"], 2, "no telegram", "--bare");
        refused(&["--interface=lo", "--mtu=1500"], 78, "1500", "1472");
        refused(&["--interface=lo", "--mtu=100"], 78, "100", "576");
        refused(&["--ttl=300"], 2, "300", "");
        refused(&["--background-every=ten"], 2, "ten", "");
        refused(&[&config("[gateway]\nmtu = 9000\n")], 78, "gateway.toml:2:7: mtu = 9000", "1472");
        refused(&[&config("[gateway]\nintreface = \"lo\"\n")], 78, "intreface", "interface");
        refused(&[&config("[gateway]\nbackground_every = \"ten\"\n")], 78, "gateway.toml:2:20", "");
        refused(&[&config("[gateway]\ninterface = \"eth8\"\n")], 78, "eth8", "lo");
        create_interface();
        refused(&[], 78, "no interface is named", "ours (10.76.0.1)");
        refused(&[&config("[gateway]\ntopics = [\"front/scan\"]\n")], 78, "no interface", "--to");
        let unwritable = {
            let mut command = env.command(&["gateway", "--json", "--no-system-config", "--interface=lo"]);
            command.env("XDG_STATE_HOME", "/dev/null").env_remove("STATE_DIRECTORY");
            Program::start(command).wait()
        };
        assert_eq!(unwritable.exit_code, Some(73), "{unwritable}");
        // The gateway uses the values of the configuration file, but command-line flags take precedence.
        let configured = config("[gateway]\ninterface = \"eth8\"\ntopics = [\"front/status\"]\nmtu = 1400\n");
        let mut gateway = env.start_gateway(&["--interface=lo", &configured]);
        let begin = gateway.await_line("line of class gateway", is_class("gateway"));
        assert_eq!((&begin["interface"], number(&begin, "longest")), (&"lo".into(), 1400));
        let line =
            gateway.await_line("a status", |line| line["class"] == "lan" && line["topic"] != "announce");
        assert_eq!(line["topic"], "status");
        assert_eq!(gateway.end(TERM).exit_code, Some(0));
    });
}
