//! Spans, and where in a trace they are: plain data in the terms of W3C Trace Context.

use std::{
    fmt,
    time::{Duration, SystemTime},
};

/// The header, or the gRPC metadata, by which a caller says where in a trace it is.
pub const TRACEPARENT: &str = "traceparent";

/// Where in a trace something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TraceContext {
    /// Which trace.
    pub trace: u128,
    /// Which span of it.
    pub span: u64,
    /// Somebody wants to see it.
    pub is_sampled: bool,
}

impl TraceContext {
    /// Reads a `traceparent`; `None` for what is none, which is then taken as not sent.
    pub fn parse(text: &str) -> Option<Self> {
        let is_hex = |text: &&str| text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        let mut parts = text.split('-');
        let mut part = |len: usize| parts.next().filter(|p| p.len() == len).filter(is_hex);
        let (version, trace, span, flags) = (part(2)?, part(32)?, part(16)?, part(2)?);
        // Later versions may say more.
        if version == "ff" || (version == "00" && parts.next().is_some()) {
            return None;
        }
        let trace = u128::from_str_radix(trace, 16).ok().filter(|trace| *trace != 0)?;
        let span = u64::from_str_radix(span, 16).ok().filter(|span| *span != 0)?;
        let flags = u8::from_str_radix(flags, 16).ok()?;
        Some(Self { trace, span, is_sampled: flags & 1 == 1 })
    }

    /// Somewhere new below `parent` or, without one, at the top of a new trace.
    pub fn below(parent: Option<Self>) -> Self {
        let random = || uuid::Uuid::new_v4().as_u128();
        Self {
            trace: parent.map_or_else(random, |parent| parent.trace),
            span: random() as u64,
            is_sampled: parent.is_none_or(|parent| parent.is_sampled),
        }
    }
}

impl fmt::Display for TraceContext {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { trace, span, is_sampled } = *self;
        write!(f, "00-{trace:032x}-{span:016x}-{:02x}", u8::from(is_sampled))
    }
}

/// What an attribute says.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A text.
    Text(String),
    /// A whole number.
    Int(i64),
    /// Another number.
    Float(f64),
    /// Yes or no.
    Bool(bool),
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Text(text.into())
    }
}
impl From<u64> for Value {
    fn from(number: u64) -> Self {
        Self::Int(i64::try_from(number).unwrap_or(i64::MAX))
    }
}
impl From<u32> for Value {
    fn from(number: u32) -> Self {
        Self::Int(number.into())
    }
}
impl From<bool> for Value {
    fn from(is_so: bool) -> Self {
        Self::Bool(is_so)
    }
}
impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Float(number)
    }
}

/// Something that took a while.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    /// Where it is.
    pub at: TraceContext,
    /// The span that it is a part of.
    pub parent: Option<u64>,
    /// It is the answer to a call of another process.
    pub is_call: bool,
    /// What it is.
    pub name: String,
    /// From when,
    pub start: SystemTime,
    /// until when.
    pub end: SystemTime,
    /// More of it.
    pub attributes: Vec<(&'static str, Value)>,
    /// Why it failed, if it did.
    pub error: Option<String>,
}

impl Span {
    /// Adds an attribute.
    pub fn say(&mut self, name: &'static str, value: impl Into<Value>) {
        self.attributes.push((name, value.into()));
    }
}

/// So many milliseconds after the beginning of 1970.
pub fn time_of(ms: i64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_millis(u64::try_from(ms).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn callers_say_where_they_are() {
        let trace = "4bf92f3577b34da6a3ce929d0e0e4736";
        let table = [
            (format!("00-{trace}-00f067aa0ba902b7-01"), Some(true)),
            (format!("00-{trace}-00f067aa0ba902b7-00"), Some(false)),
            (format!("00-{trace}-00f067aa0ba902b7-03"), Some(true)),
            (format!("01-{trace}-00f067aa0ba902b7-01-more"), Some(true)),
            (format!("00-{trace}-00f067aa0ba902b7-01-more"), None),
            (format!("ff-{trace}-00f067aa0ba902b7-01"), None),
            (format!("00-{}-00f067aa0ba902b7-01", trace.to_uppercase()), None),
            (format!("00-{trace}-+0f067aa0ba902b7-01"), None),
            (format!("00-{}-00f067aa0ba902b7-01", "0".repeat(32)), None),
            (format!("00-{trace}-0000000000000000-01"), None),
            (format!("00-{trace}-00f067aa0ba902b7"), None),
            (String::new(), None),
        ];
        for (text, wanted) in table {
            let read = TraceContext::parse(&text);
            assert_eq!(read.map(|at| at.is_sampled), wanted, "{text}");
            if let Some(at) = read {
                assert_eq!(
                    (at.span, format!("{:032x}", at.trace)),
                    (0xf0_67aa_0ba9_02b7, trace.into())
                );
                assert_eq!(TraceContext::parse(&at.to_string()), read);
            }
        }
    }

    #[test]
    fn what_is_below_is_in_the_same_trace() {
        let top = TraceContext::below(None);
        let below = TraceContext::below(Some(TraceContext { is_sampled: false, ..top }));
        assert!(top.is_sampled && !below.is_sampled);
        assert_eq!(top.trace, below.trace);
        assert_ne!(top.span, below.span);
        assert_ne!(TraceContext::below(None).trace, top.trace);
    }
}
