//! Text that must not be seen.

use std::{convert::Infallible, fmt, str::FromStr};

/// A secret. What it says is only had by [`Secret::reveal`]; logs show that there is one.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Hides a text.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// The text.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

impl FromStr for Secret {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self::new(text.trim()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn debugging_shows_no_secrets() {
        let secret: Secret = "hush\n".parse().unwrap();
        assert_eq!((secret.reveal(), format!("{secret:?}").contains("hush")), ("hush", false));
    }
}
