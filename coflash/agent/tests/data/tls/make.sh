#!/bin/sh
# Makes an authority, the certificate of a server at 127.0.0.1 from it, and another authority, all
# for the tests alone and valid for a hundred years. The keys of the authorities are thrown away.
set -e
authority() {
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 36500 -subj "/CN=$1" \
        -keyout "$1.key" -out "$1.pem" -addext basicConstraints=critical,CA:TRUE
}
authority authority
authority other
openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=server -keyout server.key -out server.csr
printf 'subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n' >server.ext
openssl x509 -req -in server.csr -CA authority.pem -CAkey authority.key -CAcreateserial -days 36500 \
    -extfile server.ext -out server.pem
# What many tutorials make for a server: its own authority (CA:TRUE).
openssl req -x509 -key server.key -days 36500 -subj /CN=server -addext subjectAltName=IP:127.0.0.1 -out own.pem
rm -f authority.key other.key server.csr server.ext authority.srl
