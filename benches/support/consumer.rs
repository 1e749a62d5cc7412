//! A consumer of the hub as a process of its own: follows a topic with the client library, wakes by event, stamps what
//! it has in its hands.

use std::io::Write;

use scanhub_client::Subscription;
use schema::ipc::Payload;
use schema::{Domain, Environment, Header, Scan, Status, Zones};

use super::{Outcome, clock, truth};

/// Follows the scans of `sensor` for ever; prints when the first of each hub's life came.
pub(crate) fn scans(domain: &str, sensor: &str) -> Outcome<()> {
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

/// Follows the scans of `sensor` for ever; prints each as it comes: `scanned SENSOR RECEIVED_NS BOOT`.
pub(crate) fn each_scan(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = subscribe::<Scan>(domain, sensor)?;
    println!("attaching {sensor}");
    loop {
        let Some(scan) = scans.next()? else { continue };
        println!("scanned {sensor} {} {}", clock::now(), scan.header().boot);
    }
}

/// Follows the telegrams of `sensor` until `count` of measured data came, then prints them; with 0 for ever, and
/// prints each as it comes. A line is `telegram SENSOR RECEIVED_NS BOOT MISSED INTACT HASH
/// READ_NS`, the last the hub's stamp of the last byte.
pub(crate) fn telegrams(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut telegrams = subscribe::<[u8]>(domain, sensor)?;
    let mut kept = Vec::with_capacity(count);
    let mut out = std::io::stdout().lock();
    writeln!(out, "attaching {sensor}")?;
    while count == 0 || kept.len() < count {
        let Some(telegram) = telegrams.next()? else { continue };
        let now = clock::now();
        let of_lms = schema::Telegram::of(telegram.header().family, &telegram);
        if of_lms.is_none_or(|telegram| telegram.command() != lms::measured::MEASURED) {
            continue;
        }
        let header = *telegram.header();
        let found = Found { now, header, missed: telegram.missed, bytes: telegram.to_vec() };
        drop(telegram);
        if count == 0 {
            write(&mut out, sensor, &found)?;
        } else {
            kept.push(found);
        }
    }
    kept.iter().try_for_each(|found| write(&mut out, sensor, found))?;
    writeln!(out, "end")?;
    Ok(())
}

/// Follows the scans or the zones of `sensor` until `count` came, then prints for each how old its telegram's last byte
/// was when the sample was in hand: `aged SENSOR NS`.
pub(crate) fn ages(topic: &str, domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let ages = match topic {
        "zones" => collect_ages::<Zones>(domain, sensor, count)?,
        _ => collect_ages::<Scan>(domain, sensor, count)?,
    };
    ages.iter().for_each(|age| println!("aged {sensor} {age}"));
    println!("end");
    Ok(())
}

fn collect_ages<P: Payload + ?Sized>(domain: &str, sensor: &str, count: usize) -> Outcome<Vec<u64>> {
    let mut samples = subscribe::<P>(domain, sensor)?;
    let mut ages = Vec::with_capacity(count);
    println!("attaching {sensor}");
    while ages.len() < count {
        let Some(sample) = samples.next()? else { continue };
        ages.push(clock::now().saturating_sub(sample.header().stamp_last_ns));
    }
    Ok(ages)
}

/// Follows the status of `sensor` for ever; prints each: `status SENSOR STATE SINCE_NS BOOT`.
pub(crate) fn statuses(domain: &str, sensor: &str) -> Outcome<()> {
    let mut statuses = subscribe::<Status>(domain, sensor)?;
    println!("attaching {sensor}");
    loop {
        let Some(status) = statuses.next()? else { continue };
        let state = status.state().map_or("unknown", schema::State::name);
        println!("status {sensor} {state} {} {}", status.since_ns, status.header().boot);
    }
}

/// Subscribes in the place where the hub of this domain puts itself.
pub(crate) fn subscribe<P: Payload + ?Sized>(domain: &str, sensor: &str) -> Outcome<Subscription<P>> {
    let places = Domain::candidates(domain, None, &Environment::of_process())?;
    Ok(Subscription::in_domain(places, sensor)?)
}

struct Found {
    now: u64,
    header: Header,
    missed: u64,
    bytes: Vec<u8>,
}

fn write(out: &mut impl Write, sensor: &str, found: &Found) -> Outcome<()> {
    let Found { now, header, missed, bytes } = found;
    let intact = lms::telegram::Telegram::check(bytes).is_some();
    let (boot, read, hash) = (header.boot, header.stamp_last_ns, truth::hash(bytes));
    Ok(writeln!(out, "telegram {sensor} {now} {boot} {missed} {intact} {hash} {read}")?)
}
