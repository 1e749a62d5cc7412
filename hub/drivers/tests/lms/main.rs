//! Tests of the protocol of the SICK LMS 2xx: framing on lines that lose bytes, replies, and telegrams with any bytes.

mod captures;
mod framer;
mod framing;
mod line;
mod replies;
