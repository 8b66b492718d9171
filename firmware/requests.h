/* What hosts ask for, and who may. Called by the courier's thread. */
#ifndef PIPEFISHD_REQUESTS_H
#define PIPEFISHD_REQUESTS_H

#include "daemon.h"
#include "session.h"

#define PF_CONTROL_MAX 1000u /* bytes: a status at its largest has about 500 */

/* Whether what somebody else did wrong may be a line of the log: one a second, or he fills the disk. Of the courier's
 * thread. */
bool pf_request_may_complain(void);

/* What the host at the other end may do. A visitor is a viewer, whatever it was let in as. */
pf_role pf_request_role(const pf_session *session);

/* Answers a request, or has the keeper do it: then pf_request_answer_profile follows. */
void pf_request_answer(pf_daemon *daemon, pf_session *session, const uint8_t *bytes, size_t size);
void pf_request_answer_profile(pf_daemon *daemon, pf_session *session, uint32_t id, bool has_failed);

/* The status message as this session gets it: bytes[PF_CONTROL_MAX]. */
pf_status pf_request_status(pf_daemon *daemon, const pf_session *session, uint8_t *bytes, size_t *n);

#endif
