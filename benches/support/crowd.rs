//! Many consumers in one process, each in a thread and with membership, queue and wake-ups of its own, as if it were a
//! process: they follow scans and count, or hold all the samples that they may and stay.

use std::sync::{Arc, Barrier};
use std::thread;
use std::time::Duration;

use schema::{Scan, limits};

use super::consumer::subscribe;
use super::{Outcome, clock};

/// Follows the scans of `sensor` with `count` consumers for `seconds` from when all of them have one; prints for each
/// `followed RECEIVED MISSED PUBLISHED`, the last from its own first sample to its last.
pub(crate) fn follow(domain: &str, sensor: &str, count: usize, seconds: u64) -> Outcome<()> {
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
        let Counted { received, missed, published } = thread.join().map_err(|_| "a consumer panicked")??;
        println!("followed {received} {missed} {published}");
    }
    println!("end");
    Ok(())
}

/// Takes all the samples that `count` consumers may hold, says so, and stays.
pub(crate) fn hold(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut consumers = (0..count).map(|_| subscribe::<Scan>(domain, sensor)).collect::<Outcome<Vec<_>>>()?;
    let mut held = Vec::new();
    for consumer in &mut consumers {
        for _ in 0..limits::BORROWED {
            held.extend(consumer.next()?);
        }
    }
    println!("holding {}", held.len());
    loop {
        thread::park();
    }
}

/// Attaches `count` consumers and stays; says so, or why not.
pub(crate) fn stay(domain: &str, sensor: &str, count: usize) -> Outcome<()> {
    let mut consumers = Vec::new();
    for _ in 0..count {
        let mut consumer = subscribe::<Scan>(domain, sensor)?.timeout(LONG);
        if let Err(failure) = consumer.next() {
            println!("refused {} {}", consumers.len(), failure.message);
            break;
        }
        consumers.push(consumer);
    }
    println!("staying {}", consumers.len());
    loop {
        for consumer in &mut consumers {
            while consumer.try_next()?.is_some() {}
        }
        thread::sleep(Duration::from_millis(50));
    }
}

struct Counted {
    received: u64,
    missed: u64,
    published: u64,
}

fn count_scans(domain: &str, sensor: &str, all: &Barrier, seconds: u64) -> Outcome<Counted> {
    let last = |scan: Option<scanhub_client::Received<Scan>>| {
        Ok::<_, &str>(scan.ok_or("nothing came")?.header().topic_seq)
    };
    let attached = || -> Outcome<_> {
        let mut scans = subscribe::<Scan>(domain, sensor)?.timeout(LONG);
        last(scans.next()?)?;
        Ok(scans)
    };
    let attached = attached();
    // One that cannot come is not waited for by the others.
    all.wait();
    let mut scans = attached?;
    // What queued up while the others came is none of the count.
    while scans.try_next()?.is_some() {}
    let first = last(scans.next()?)?;
    let end = clock::now() + seconds * 1_000_000_000;
    let mut counted = Counted { received: 1, missed: 0, published: 1 };
    while clock::now() < end {
        let scan = scans.next()?.ok_or("nothing came")?;
        counted.received += 1;
        counted.missed += scan.missed;
        counted.published = scan.header().topic_seq - first + 1;
    }
    Ok(counted)
}

const LONG: Duration = Duration::from_secs(20);
