//! Hosts that may be called, and addresses that are everybody's.

use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr},
    str::FromStr,
};

/// Hosts by name: `example.org` that one alone, `*.example.org` all below it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostPattern {
    name: String,
    is_below: bool,
}

impl FromStr for HostPattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let name = text.strip_prefix("*.").unwrap_or(text).to_lowercase();
        let is_host = |c: char| c.is_ascii_alphanumeric() || ".-[]:".contains(c);
        if name.is_empty() || !name.chars().all(is_host) || name.starts_with('.') {
            return Err(
                "use the name of a host, or *.NAME for all below it, without a scheme".into()
            );
        }
        Ok(Self { is_below: text.starts_with("*."), name })
    }
}

impl HostPattern {
    /// Whether a host, in lower case, is meant.
    pub(super) fn fits(&self, host: &str) -> bool {
        match host.strip_suffix(&self.name) {
            Some("") => !self.is_below,
            Some(above) => self.is_below && above.ends_with('.'),
            None => false,
        }
    }
}

/// Networks that are not everybody's: first address, and bits that they share.
#[rustfmt::skip]
const PRIVATE_V4: [([u8; 4], u32); 15] = [
    ([0, 0, 0, 0], 8), ([10, 0, 0, 0], 8), ([100, 64, 0, 0], 10), ([127, 0, 0, 0], 8),
    ([169, 254, 0, 0], 16), ([172, 16, 0, 0], 12), ([192, 0, 0, 0], 24), ([192, 0, 2, 0], 24),
    ([192, 88, 99, 0], 24), ([192, 168, 0, 0], 16), ([198, 18, 0, 0], 15), ([198, 51, 100, 0], 24),
    ([203, 0, 113, 0], 24), ([224, 0, 0, 0], 4), ([240, 0, 0, 0], 4),
];

/// The same of IPv6. Global unicast is 2000::/3: all outside it is left out anyway.
const PRIVATE_V6: [(Ipv6Addr, u32); 4] = [
    (Ipv6Addr::new(0x2001, 0, 0, 0, 0, 0, 0, 0), 23),
    (Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 0), 32),
    (Ipv6Addr::new(0x2002, 0, 0, 0, 0, 0, 0, 0), 16),
    (Ipv6Addr::new(0x3fff, 0, 0, 0, 0, 0, 0, 0), 20),
];
const GLOBAL_V6: (Ipv6Addr, u32) = (Ipv6Addr::new(0x2000, 0, 0, 0, 0, 0, 0, 0), 3);

/// Whether an address is everybody's: not this machine's, and not of a private or special network. Addresses of
/// IPv6 that stand for some of IPv4 are none.
pub(super) fn is_public(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => {
            let is_in = |(network, bits): &([u8; 4], u32)| {
                (v4.to_bits() ^ Ipv4Addr::from(*network).to_bits()) >> (32 - bits) == 0
            };
            !PRIVATE_V4.iter().any(is_in)
        }
        IpAddr::V6(v6) => {
            let is_in = |(network, bits): &(Ipv6Addr, u32)| {
                (v6.to_bits() ^ network.to_bits()) >> (128 - bits) == 0
            };
            is_in(&GLOBAL_V6) && !PRIVATE_V6.iter().any(is_in)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn private_and_special_networks_are_known() {
        let public = [
            "1.1.1.1",
            "93.184.216.34",
            "172.15.255.255",
            "172.32.0.0",
            "100.128.0.1",
            "2606:4700::1111",
        ];
        let private = [
            "0.0.0.0",
            "10.1.2.3",
            "100.64.0.1",
            "127.0.0.1",
            "127.9.9.9",
            "169.254.169.254",
            "172.16.0.1",
            "172.31.255.255",
            "192.168.1.1",
            "198.18.0.1",
            "224.0.0.1",
            "255.255.255.255",
            "::",
            "::1",
            "fe80::1",
            "fc00::1",
            "fd00:ec2::254",
            "ff02::1",
            "::ffff:10.0.0.1",
            "::ffff:1.1.1.1",
            "64:ff9b::a00:1",
            "2002:a00:1::",
            "2001:0:1::1",
            "2001:db8::1",
        ];
        for (addresses, wanted) in [(&public[..], true), (&private, false)] {
            for address in addresses {
                assert_eq!(is_public(address.parse().unwrap()), wanted, "{address}");
            }
        }
    }

    #[test]
    fn patterns_mean_one_host_or_all_below_it() {
        for bad in ["", "*", "*.", "https://a.test", "a/b", "u@a.test"] {
            assert!(bad.parse::<HostPattern>().is_err(), "{bad}");
        }
        for (pattern, host, wanted) in [
            ("a.test", "a.test", true),
            ("A.Test", "a.test", true),
            ("a.test", "b.a.test", false),
            ("*.a.test", "b.a.test", true),
            ("*.a.test", "c.b.a.test", true),
            ("*.a.test", "a.test", false),
            ("*.a.test", "evila.test", false),
        ] {
            assert_eq!(
                pattern.parse::<HostPattern>().unwrap().fits(host),
                wanted,
                "{pattern} {host}"
            );
        }
    }
}
