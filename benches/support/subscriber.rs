//! Subscribers as separate processes. They receive a topic with the client library, sleep until they are woken, and
//! print the times at which samples arrived. Several subscribers can share a process. Each of them has its own thread,
//! its own membership in the domain, its own queue and its own wake-ups.

use scanhub_drivers::lms;
use std::io::Write;
use std::sync::{Arc, Barrier};
use std::thread;
use std::time::Duration;

use scanhub_client::{Subscriber, SubscriberBuilder};
use scanhub_schema::{Header, Scan, Status, limits};
use scanhub_shm::Payload;

use super::environment::STEP_TIMEOUT;
use super::{Outcome, clock, truth};

/// Receives the scans of `sensor` forever, and prints the time of the first scan of each run of the hub.
pub(crate) fn print_first_scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = subscribe::<Scan>(domain, sensor)?;
    let mut boot = 0;
    println!("attaching {sensor}");
    loop {
        let Some(scan) = scans.next()? else { continue };
        if scan.header().boot != boot {
            boot = scan.header().boot;
            println!("scan {sensor} {} {boot}", clock::now());
        }
    }
}

/// Receives the scans of `sensor` forever, and prints a line `scanned SENSOR RECEIVED_NS BOOT` for each scan.
pub(crate) fn print_scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = subscribe::<Scan>(domain, sensor)?;
    println!("attaching {sensor}");
    loop {
        let Some(scan) = scans.next()? else { continue };
        println!("scanned {sensor} {} {}", clock::now(), scan.header().boot);
    }
}

/// Receives telegrams of `sensor` until `count` telegrams with measured data have arrived, and then prints these
/// telegrams. If `count` is 0, receives forever and prints each telegram at once. The line for a telegram is `telegram
/// SENSOR RECEIVED_NS BOOT MISSED INTACT HASH READ_NS`. READ_NS is the hub's stamp of the last byte.
pub(crate) fn print_telegrams(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut telegrams = subscribe::<[u8]>(domain, sensor)?;
    let mut received = Vec::with_capacity(count);
    let mut out = std::io::stdout().lock();
    writeln!(out, "attaching {sensor}")?;
    while count == 0 || received.len() < count {
        let Some(telegram) = telegrams.next()? else { continue };
        let now = clock::now();
        let of_lms = scanhub_schema::Telegram::of(telegram.header().family, &telegram);
        if of_lms.is_none_or(|telegram| telegram.command() != lms::measured::MEASURED) {
            continue;
        }
        let header = *telegram.header();
        let found = ReceivedSample { now, header, missed: telegram.missed, bytes: telegram.to_vec() };
        drop(telegram);
        if count == 0 {
            write(&mut out, sensor, &found)?;
        } else {
            received.push(found);
        }
    }
    received.iter().try_for_each(|found| write(&mut out, sensor, found))?;
    writeln!(out, "end")?;
    Ok(())
}

/// Receives scans of `sensor` until `count` scans have arrived. Then prints `aged SENSOR NS` for each scan: the time
/// from the telegram's last byte until the scan was received.
pub(crate) fn print_ages(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut scans = subscribe::<Scan>(domain, sensor)?;
    let mut ages = Vec::with_capacity(count);
    println!("attaching {sensor}");
    while ages.len() < count {
        let Some(scan) = scans.next()? else { continue };
        ages.push(clock::now().saturating_sub(scan.header().stamp_last_ns));
    }
    ages.iter().for_each(|age| println!("aged {sensor} {age}"));
    println!("end");
    Ok(())
}

/// Receives the status of `sensor` forever, and prints a line `status SENSOR STATE SINCE_NS BOOT` for each sample.
pub(crate) fn print_statuses(domain: &str, sensor: &str) -> Outcome<()> {
    let mut statuses = subscribe::<Status>(domain, sensor)?;
    println!("attaching {sensor}");
    loop {
        let Some(status) = statuses.next()? else { continue };
        let state = status.state().map_or("unknown", scanhub_schema::State::name);
        println!("status {sensor} {state} {} {}", status.since_ns, status.header().boot);
    }
}

/// Subscribes to a topic of the hub in this domain.
pub(crate) fn subscribe<P: Payload + ?Sized>(domain: &str, sensor: &str) -> Outcome<Subscriber<P>> {
    Ok(builder(domain, sensor).open()?)
}

/// Returns the builder of a subscriber to a topic of the hub in this domain.
pub(crate) fn builder<P: Payload + ?Sized>(domain: &str, sensor: &str) -> SubscriberBuilder<P> {
    Subscriber::builder(sensor).domain(domain)
}

struct ReceivedSample {
    now: u64,
    header: Header,
    missed: u64,
    bytes: Vec<u8>,
}

fn write(out: &mut impl Write, sensor: &str, sample: &ReceivedSample) -> Outcome<()> {
    let ReceivedSample { now, header, missed, bytes } = sample;
    let intact = lms::telegram::Telegram::check(bytes).is_some();
    let (boot, read, hash) = (header.boot, header.stamp_last_ns, truth::hash(bytes));
    Ok(writeln!(out, "telegram {sensor} {now} {boot} {missed} {intact} {hash} {read}")?)
}

/// Attaches `count` subscribers to the scans of `sensor`. After each subscriber has received a scan, they receive for
/// `seconds` seconds. Prints `followed RECEIVED MISSED PUBLISHED` for each subscriber. PUBLISHED is the number of scans
/// that the hub published from the subscriber's first sample to its last one.
pub(crate) fn count_samples(domain: &str, sensor: &str, count: usize, seconds: u64) -> Outcome<()> {
    let all = Arc::new(Barrier::new(count + 1));
    let threads: Vec<_> = (0..count)
        .map(|_| {
            let (domain, sensor, all) = (domain.to_owned(), sensor.to_owned(), all.clone());
            thread::spawn(move || {
                count_scans(&domain, &sensor, &all, seconds).map_err(|error| error.to_string())
            })
        })
        .collect();
    all.wait();
    println!("following {count}");
    for thread in threads {
        let SampleCounts { received, missed, published } =
            thread.join().map_err(|_| "a subscriber panicked")??;
        println!("followed {received} {missed} {published}");
    }
    println!("end");
    Ok(())
}

/// Takes as many samples as `count` subscribers may hold, prints the number of samples, and keeps the samples.
pub(crate) fn hold_samples(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut subscribers =
        (0..count).map(|_| subscribe::<Scan>(domain, sensor)).collect::<Outcome<Vec<_>>>()?;
    let mut held = Vec::new();
    for subscriber in &mut subscribers {
        for _ in 0..limits::MAX_BORROWED_SAMPLES {
            held.extend(subscriber.next()?);
        }
    }
    println!("holding {}", held.len());
    loop {
        thread::park();
    }
}

/// Attaches `count` subscribers and keeps them attached. Prints the number of attached subscribers, and the reason if
/// the hub's topic refuses one of them.
pub(crate) fn hold_slots(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut subscribers = Vec::new();
    for _ in 0..count {
        let mut subscriber = builder::<Scan>(domain, sensor).timeout(STEP_TIMEOUT).open()?;
        if let Err(failure) = subscriber.next() {
            println!("refused {} {}", subscribers.len(), failure.message());
            break;
        }
        subscribers.push(subscriber);
    }
    println!("staying {}", subscribers.len());
    loop {
        for subscriber in &mut subscribers {
            while subscriber.try_next()?.is_some() {}
        }
        thread::sleep(Duration::from_millis(50));
    }
}

struct SampleCounts {
    received: u64,
    missed: u64,
    published: u64,
}

fn count_scans(domain: &str, sensor: &str, all: &Barrier, seconds: u64) -> Outcome<SampleCounts> {
    let last = |scan: Option<scanhub_client::Received<Scan>>| {
        Ok::<_, &str>(scan.ok_or("no scan arrived")?.header().topic_seq)
    };
    let attached = || -> Outcome<_> {
        let mut scans = builder::<Scan>(domain, sensor).timeout(STEP_TIMEOUT).open()?;
        last(scans.next()?)?;
        Ok(scans)
    };
    let attached = attached();
    // Wait even after an error, because a subscriber that fails must not block the others.
    all.wait();
    let mut scans = attached?;
    // Samples that were queued while other subscribers attached do not count.
    while scans.try_next()?.is_some() {}
    let first = last(scans.next()?)?;
    let end = clock::now() + seconds * 1_000_000_000;
    let mut counted = SampleCounts { received: 1, missed: 0, published: 1 };
    while clock::now() < end {
        let scan = scans.next()?.ok_or("no scan arrived")?;
        counted.received += 1;
        counted.missed += scan.missed;
        counted.published = scan.header().topic_seq - first + 1;
    }
    Ok(counted)
}
