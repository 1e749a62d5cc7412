//! The protocol of the SICK LMS 2xx: framing on lines that lose bytes, replies, and any bytes at all.

mod captures;
mod framer;
mod framing;
mod line;
mod replies;
