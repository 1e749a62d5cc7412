//! Who may connect: certificates and users, as Zenoh's own configuration says. The certificates are made here.

use std::process::Command;

use crate::testkit::{INT, Program, TestEnv};
use crate::{address, bridge};

/// Runs `openssl` in the directory of this test.
fn openssl(env: &TestEnv, words: &str) {
    let output = Command::new("openssl").args(words.split(' ')).current_dir(env.path("")).output();
    let output = output.expect("openssl is installed");
    assert!(output.status.success(), "openssl {words}: {}", String::from_utf8_lossy(&output.stderr));
}

/// An authority called `ca`, and a certificate of it for the loopback called `name`.
fn certificates(env: &TestEnv, ca: &str, names: &[&str]) {
    openssl(
        env,
        &format!("req -x509 -newkey rsa:2048 -nodes -keyout {ca}.key -out {ca}.pem -days 2 -subj /CN={ca}"),
    );
    env.file("ext", "subjectAltName=IP:127.0.0.1,DNS:localhost\nextendedKeyUsage=serverAuth,clientAuth\n");
    for name in names {
        openssl(
            env,
            &format!("req -newkey rsa:2048 -nodes -keyout {name}.key -out {name}.csr -subj /CN={name}"),
        );
        openssl(
            env,
            &format!(
                "x509 -req -in {name}.csr -CA {ca}.pem -CAkey {ca}.key -CAcreateserial -out {name}.pem -days 2 -extfile ext"
            ),
        );
    }
}

/// A file of Zenoh's configuration: mutual TLS by the authority `ca` with the certificate `own`.
fn tls(env: &TestEnv, file: &str, ca: &str, own: &str) -> String {
    let path = |name: &str| env.word(name);
    let (ca, certificate, key) =
        (path(&format!("{ca}.pem")), path(&format!("{own}.pem")), path(&format!("{own}.key")));
    env.file(
        file,
        format!(
            "{{ transport: {{ link: {{ tls: {{ enable_mtls: true, root_ca_certificate: '{ca}', \
             listen_certificate: '{certificate}', listen_private_key: '{key}', \
             connect_certificate: '{certificate}', connect_private_key: '{key}' }} }} }} }}"
        ),
    )
}

fn is_up(program: &mut Program) {
    crate::linked(program);
}

/// What it says of why it is not connected.
fn reason(program: &mut Program, words: &[&str]) {
    program.await_line("the reason", |line| {
        line["class"] == "bridge_link"
            && line["state"] == "failing"
            && line["message"].as_str().is_some_and(|message| words.iter().any(|word| message.contains(word)))
    });
}

#[test]
fn who_has_a_certificate_of_the_authority_is_connected_and_nobody_else() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    certificates(&env, "ca", &["robot", "desk"]);
    certificates(&env, "stranger", &["thief"]);
    let at = address("tls");
    let of = |file: &str, ca: &str, own: &str| tls(&env, file, ca, own);
    let (mut robot, _) = bridge(&env, &["--listen", &at, "--config", &of("robot.json5", "ca", "robot")]);
    let desk = of("desk.json5", "ca", "desk");
    let (mut here, _) = bridge(&other, &["--connect", &at, "--publish", "--config", &desk]);
    is_up(&mut here);
    is_up(&mut robot);
    assert_eq!(here.end(INT).code, Some(0));
    // One that does not know the robot's authority, and one that the robot does not know.
    for (file, ca) in [("a.json5", "stranger"), ("b.json5", "ca")] {
        let config = of(file, ca, "thief");
        let (mut thief, _) = bridge(&other, &["--connect", &at, "--publish", "--config", &config]);
        reason(&mut thief, &["ertificate", "UnknownCA", "UnknownIssuer"]);
        assert_eq!(thief.end(INT).of_class("bridge_published").len(), 0);
    }
    let outcome = other.run(&[
        "bridge",
        "--json",
        "--connect",
        &at,
        "--config",
        &other.file("none.json5", "{ transport: { link: { tls: { root_ca_certificate: '/nowhere' } } } }"),
    ]);
    assert_eq!(outcome.code, Some(78), "{outcome}");
}

#[test]
fn who_does_not_know_the_password_is_refused() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    let users = env.file("users", "robot:secret\ndesk:word\n");
    let auth = |file: &str, user: &str, password: &str, more: &str| {
        let text = format!(
            "{{ transport: {{ auth: {{ usrpwd: {{ user: '{user}', password: '{password}'{more} }} }} }} }}"
        );
        env.file(file, text)
    };
    let at = address("tcp");
    let listens = auth("robot.json5", "robot", "secret", &format!(", dictionary_file: '{users}'"));
    let (mut robot, _) = bridge(&env, &["--listen", &at, "--config", &listens]);
    let (mut here, _) =
        bridge(&other, &["--connect", &at, "--publish", "--config", &auth("desk.json5", "desk", "word", "")]);
    is_up(&mut here);
    is_up(&mut robot);
    assert_eq!(here.end(INT).code, Some(0));
    let (mut thief, _) = bridge(
        &other,
        &["--connect", &at, "--publish", "--config", &auth("thief.json5", "desk", "guess", "")],
    );
    reason(&mut thief, &["Unable to connect"]);
    thief.end(INT);
    robot.await_line("who was refused", |line| line["class"] == "bridge_link" && line["state"] == "failing");
}
