/* What the TLS listener takes of the trust beside its public functions. */
#ifndef PIPEFISH_TRUST_PRIVATE_H
#define PIPEFISH_TRUST_PRIVATE_H

#include "pipefish/drivers/trust.h"

#include <openssl/ssl.h>

EVP_PKEY *pf_trust_private_key(const pf_trust *trust);
X509 *pf_trust_certificate(const pf_trust *trust);

/* SHA-256 of a certificate's public key. False: libcrypto failed. */
bool pf_certificate_key(X509 *certificate, uint8_t key[32]);

#endif
