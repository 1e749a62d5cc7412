//! Subscribers as separate processes. They receive a topic with the client library, sleep until they are woken, and
//! print the time at which a sample had arrived. Many subscribers can share a process, but each one has its own thread,
//! membership, queue and wake-ups.

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

/// Receives the scans of `sensor` forever, and prints each: `scanned SENSOR RECEIVED_NS BOOT`.
pub(crate) fn print_scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = subscribe::<Scan>(domain, sensor)?;
    println!("attaching {sensor}");
    loop {
        let Some(scan) = scans.next()? else { continue };
        println!("scanned {sensor} {} {}", clock::now(), scan.header().boot);
    }
}

/// Receives telegrams of `sensor` until `count` telegrams with measured data have arrived, and then prints them. With
/// 0, receives forever and prints each telegram at once. A line is `telegram SENSOR RECEIVED_NS BOOT MISSED INTACT HASH
/// READ_NS`. READ_NS is the hub's stamp of the last byte.
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

/// Receives the status of `sensor` forever, and prints each: `status SENSOR STATE SINCE_NS BOOT`.
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

/// Subscribes `count` times to the scans of `sensor`, and receives for `seconds` after each subscriber has a scan.
/// Prints `followed RECEIVED MISSED PUBLISHED` for each subscriber. PUBLISHED counts from the subscriber's first sample
/// to its last one.
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

/// Takes as many samples as `count` subscribers may hold, prints their number, and keeps them.
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

/// Attaches `count` subscribers and keeps them. Prints the number of attached subscribers, and the reason if one is
/// refused.
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
    // A subscriber that fails must not block the others.
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
