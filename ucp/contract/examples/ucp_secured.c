/*
 * Keys for ucp_agent.c, which includes this file if it is compiled with -DSECURED and -lcrypto (OpenSSL 3): the
 * chapter "Secured missions" of ucp/contract/CONTRACT.md. A layer around the protocol, which knows nothing of it: what is heard
 * is opened before it is read, and what is to be sent is sealed once an input is over.
 */
#include <openssl/evp.h>
#include <openssl/hmac.h>

enum {
    KEY = 32, SIGNATURE = 64, TAG = 16, NONCE = 12, MISSION_ID = 16, BOOT = 16, CLEAR = 36, SEAL = TAG + SIGNATURE,
    ASKED_BY = 24, REVOCATION = 10, CHALLENGE, ECHO, AHEAD = 4096, FOLLOWED = AHEAD / 2,
    WINDOW = 1024, WORDS = WINDOW / 64 + 1, MAX_REVOKED = 256, SEALED_EVENTS = KEY + TAG, TELL_AGAIN_S = 5,
    ALL = 0, CHALLENGE_AGAIN_S = 5, TRUST_AFTER_S = 2, MAX_CHALLENGED = 256
};

typedef struct { uint32_t sender, sequence; uint8_t boot[BOOT]; } Request;

typedef struct Opened {                                 /* what came, if it is authentic */
    int type;
    uint32_t sender, sequence;
    uint8_t boot[BOOT], signature[SIGNATURE];           /* signature: of the block that it carries */
    Request request;                                    /* that it answers */
    uint64_t revocations;
} Opened;

typedef struct {                                        /* of another sender: the life that it has */
    uint8_t boot[BOOT], latest[BOOT];                   /* latest: the greatest boot of the sender so far */
    uint64_t word[WORDS];                               /* a ring: which sequence numbers have come (RFC 6479) */
    int64_t newest;
    uint32_t asked[REVOCATION];                         /* by type of a request: the newest sequence of it */
} Life;

typedef struct {                                        /* challenges to an agent, or to ALL; and those that it sent */
    bool due, has_sent;
    double sent_at;
    uint32_t sequence;                                  /* of the newest challenge to it */
    uint32_t counts_from;                               /* the sequence of a challenge from which on its echo counts */
    Buf received;                                       /* boot and sequence of its newest challenge of each boot */
} Challenge;

typedef struct { Hash block; uint8_t signature[SIGNATURE]; } Signed;

struct Keys {
    uint8_t mission[MISSION_ID], authority[KEY], private_key[KEY], public_key[KEY], depot[KEY], boot[BOOT];
    bool has_depot, seals, draws;                       /* draws: ephemeral keys are random, with a clock and UDP */
    double epoch_s, begun_s, until_s;                   /* mission seconds: of its start, and of the end of the epoch */
    uint64_t epoch, first, followed;                    /* of its clock, of the bundle, and of what it received */
    uint8_t secret[KEY], before[KEY];                   /* of the clock's epoch, and of the one before */
    Buf later;                                          /* the secrets of epochs after it, as far as they were needed */
    bool has_before, moved;                             /* moved: the bundle on disk is out of date */
    bool is_first, has_begun, complete;                 /* complete: it has received all datagrams that it accepts */
    uint64_t bundle_us;                                 /* the start of the last life with this bundle */
    Challenge *challenges[AGENT_IDS];
    Life *waiting[AGENT_IDS];                           /* lives of senders that echoed, before they are trusted */
    bool has_challenged;
    double challenged_at;
    Buf echoes;                                         /* sender, boot and sequence of the challenges to answer */
    uint32_t control, next, exports;                    /* next: after the greatest sequence of a message */
    size_t vehicles_len;
    uint8_t *vehicles[AGENT_IDS];                       /* public keys, NULL of who has none */
    Life *lives[AGENT_IDS];
    bool has_asked[REVOCATION];
    uint32_t asked[REVOCATION];                         /* its own newest request of a type */
    Signed *held;                                       /* makers' signatures of blocks */
    size_t held_len, held_cap;
    Buf revocations;                                    /* bodies, each behind its length (2 bytes) */
    uint64_t digest;                                    /* of the revoked agents, 0 if there are none */
    bool revoked[AGENT_IDS], tells, has_told;
    double told_at;
    uint64_t lived_us;                                  /* when the last life began that a store tells of */
};

/* --- Primitives -------------------------------------------------------------------------------------------------- */

static void hmac(const uint8_t *key, size_t key_len, const Buf *data, uint8_t out[32]) {
    unsigned n = 32;
    HMAC(EVP_sha256(), key, (int)key_len, data->data, data->len, out, &n);
}

static void expand(const uint8_t key[KEY], const Buf *info, uint8_t *out, size_t n) {   /* HKDF-Expand (RFC 5869) */
    uint8_t block[32];
    Buf in = {0};
    for (uint8_t counter = 1; n > 0; counter++) {
        size_t take = n < 32 ? n : 32;
        put(&in, info->data, info->len);
        put_byte(&in, counter);
        hmac(key, KEY, &in, block);
        memcpy(out, block, take);
        out += take;
        n -= take;
        in.len = 0;
        put(&in, block, 32);
    }
    free(in.data);
}

static void put_tag(Buf *b, const char *tag, const Keys *k) {      /* with the 0 behind it, and the mission */
    put(b, tag, strlen(tag) + 1);
    put(b, k->mission, MISSION_ID);
}

static void sign(const uint8_t key[KEY], const Buf *data, uint8_t signature[SIGNATURE]) {
    size_t n = SIGNATURE;
    EVP_PKEY *pkey = EVP_PKEY_new_raw_private_key(EVP_PKEY_ED25519, NULL, key, KEY);
    EVP_MD_CTX *context = EVP_MD_CTX_new();
    if (EVP_DigestSignInit(context, NULL, NULL, NULL, pkey) != 1
        || EVP_DigestSign(context, signature, &n, data->data, data->len) != 1)
        abort();
    EVP_MD_CTX_free(context);
    EVP_PKEY_free(pkey);
}

static bool verify(const uint8_t key[KEY], const Buf *data, const uint8_t signature[SIGNATURE]) {
    EVP_PKEY *pkey = EVP_PKEY_new_raw_public_key(EVP_PKEY_ED25519, NULL, key, KEY);
    EVP_MD_CTX *context = EVP_MD_CTX_new();
    bool good = pkey != NULL && EVP_DigestVerifyInit(context, NULL, NULL, NULL, pkey) == 1
             && EVP_DigestVerify(context, signature, SIGNATURE, data->data, data->len) == 1;
    EVP_MD_CTX_free(context);
    EVP_PKEY_free(pkey);
    return good;
}

static bool public_of(int type, const uint8_t private_key[KEY], uint8_t public_key[KEY]) {
    size_t n = KEY;
    EVP_PKEY *pkey = EVP_PKEY_new_raw_private_key(type, NULL, private_key, KEY);
    bool good = pkey != NULL && EVP_PKEY_get_raw_public_key(pkey, public_key, &n) == 1;
    EVP_PKEY_free(pkey);
    return good;
}

static bool agree(const uint8_t private_key[KEY], const uint8_t public_key[KEY], uint8_t shared[KEY]) {   /* X25519 */
    size_t n = KEY;
    EVP_PKEY *own = EVP_PKEY_new_raw_private_key(EVP_PKEY_X25519, NULL, private_key, KEY);
    EVP_PKEY *peer = EVP_PKEY_new_raw_public_key(EVP_PKEY_X25519, NULL, public_key, KEY);
    EVP_PKEY_CTX *context = EVP_PKEY_CTX_new(own, NULL);
    bool good = EVP_PKEY_derive_init(context) == 1 && EVP_PKEY_derive_set_peer(context, peer) == 1
             && EVP_PKEY_derive(context, shared, &n) == 1;
    EVP_PKEY_CTX_free(context);
    EVP_PKEY_free(peer);
    EVP_PKEY_free(own);
    return good;
}

static void encrypt(const uint8_t key[KEY], const uint8_t nonce[NONCE], const uint8_t *plain, size_t n,
                    const uint8_t *clear, size_t clear_len, uint8_t *out) {    /* n bytes and a tag */
    int len;
    EVP_CIPHER_CTX *context = EVP_CIPHER_CTX_new();
    EVP_EncryptInit_ex(context, EVP_chacha20_poly1305(), NULL, key, nonce);
    if (clear_len > 0)
        EVP_EncryptUpdate(context, NULL, &len, clear, (int)clear_len);
    EVP_EncryptUpdate(context, out, &len, plain, (int)n);
    EVP_EncryptFinal_ex(context, out + n, &len);
    EVP_CIPHER_CTX_ctrl(context, EVP_CTRL_AEAD_GET_TAG, TAG, out + n);
    EVP_CIPHER_CTX_free(context);
}

static bool decrypt(const uint8_t key[KEY], const uint8_t nonce[NONCE], const uint8_t *sealed, size_t n,
                    const uint8_t *clear, size_t clear_len, uint8_t *out) {    /* n with the tag */
    int len;
    EVP_CIPHER_CTX *context = EVP_CIPHER_CTX_new();
    EVP_DecryptInit_ex(context, EVP_chacha20_poly1305(), NULL, key, nonce);
    EVP_DecryptUpdate(context, NULL, &len, clear, (int)clear_len);
    EVP_DecryptUpdate(context, out, &len, sealed, (int)(n - TAG));
    EVP_CIPHER_CTX_ctrl(context, EVP_CTRL_AEAD_SET_TAG, TAG, (uint8_t *)(uintptr_t)sealed + n - TAG);
    bool good = EVP_DecryptFinal_ex(context, out + n - TAG, &len) == 1;
    EVP_CIPHER_CTX_free(context);
    return good;
}

static const uint8_t *mission_depot(const Mission *m) { /* to whom event data is sealed, NULL if it is not */
    static const char tag[] = "UCP depot key";
    size_t n = m->initial_data.len;
    bool seals = n >= sizeof tag - 1 + KEY
              && memcmp(m->initial_data.data + n - KEY - (sizeof tag - 1), tag, sizeof tag - 1) == 0;
    return seals ? m->initial_data.data + n - KEY : NULL;
}

/* --- The bundle -------------------------------------------------------------------------------------------------- */

static bool json_hex(Json *j, uint32_t at, uint8_t *out, size_t bytes) {
    size_t n;
    if (kind(j, at) != '"') return false;
    const char *text = json_text(j, at, &n);
    for (size_t i = 0; n == 2 * bytes && i < bytes; i++) {
        int high = hex_digit(text[2 * i]), low = hex_digit(text[2 * i + 1]);
        if (high < 0 || low < 0) return false;
        out[i] = (uint8_t)(high << 4 | low);
    }
    return n == 2 * bytes;
}

static void keys_free(Agent *a) {
    Keys *k = a->keys;
    if (k == NULL) return;
    for (size_t i = 0; i < AGENT_IDS; i++) {
        free(k->vehicles[i]);
        free(k->lives[i]);
        free(k->waiting[i]);
        if (k->challenges[i] != NULL)
            free(k->challenges[i]->received.data);
        free(k->challenges[i]);
    }
    free(k->held);
    free(k->revocations.data);
    free(k->echoes.data);
    if (k->later.len > 0)
        OPENSSL_cleanse(k->later.data, k->later.len);
    free(k->later.data);
    OPENSSL_cleanse(k, sizeof *k);
    free(k);
    a->keys = NULL;
}

/* What the bundle says, which is never shown; `boot` is the first 8 or all 16 bytes of which life this is. */
static bool keys_read(Agent *a, Json *j, uint32_t bundle, const uint8_t boot[BOOT], Fault *fault) {
    keys_free(a);
    Keys *k = a->keys = grow(NULL, sizeof *k);
    memset(k, 0, sizeof *k);
    memcpy(k->boot, boot, BOOT);
    uint32_t vehicles = member(j, bundle, "vehicles"), depot = member(j, bundle, "depot");
    uint64_t agent_id;
    k->has_depot = depot != 0 && kind(j, depot) != 'n';
    if (!says(j, member(j, bundle, "schema"), "ucp-bundle/1") || kind(j, vehicles) != '{'
        || !json_hex(j, member(j, bundle, "mission"), k->mission, MISSION_ID)
        || !json_hex(j, member(j, bundle, "authority"), k->authority, KEY)
        || (k->has_depot && !json_hex(j, depot, k->depot, KEY))
        || !json_double(j, member(j, bundle, "epoch_s"), &k->epoch_s) || k->epoch_s < 1 || k->epoch_s > 2678400
        || !json_hex(j, member(j, bundle, "private_key"), k->private_key, KEY)
        || !json_hex(j, member(j, bundle, "group_secret"), k->secret, KEY)
        || !json_uint(j, member(j, bundle, "epoch"), 0, UINT32_MAX, &k->epoch)
        || !json_uint(j, member(j, bundle, "agent_id"), 1, AGENT_IDS - 1, &agent_id))
        return fail(fault, STATUS_WRONG, "The bundle of keys is none of the schema ucp-bundle/1.");
    for (uint32_t i = vehicles + 1; i < j->node[vehicles].end; i = j->node[i + 1].end) {
        uint8_t key[KEY];
        size_t n, id = 0;
        const char *name = json_text(j, i, &n);
        for (size_t c = 0; c < n && n <= 5; c++)
            id = name[c] >= '0' && name[c] <= '9' ? id * 10 + (size_t)(name[c] - '0') : AGENT_IDS;
        if (id < 1 || id >= AGENT_IDS || !json_hex(j, i + 1, key, KEY))
            return fail(fault, STATUS_WRONG, "The bundle of keys names a vehicle without a key.");
        if (k->vehicles[id] == NULL) {
            k->vehicles[id] = grow(NULL, KEY);
            k->vehicles_len++;
        }
        memcpy(k->vehicles[id], key, KEY);
    }
    for (size_t i = 0; i < a->m.roster_len; i++)
        if (k->vehicles[a->m.roster[i]] == NULL)
            return fail(fault, STATUS_WRONG, "The bundle has no key of agent %u.", a->m.roster[i]);
    if (agent_id != a->m.agent_id || !public_of(EVP_PKEY_ED25519, k->private_key, k->public_key)
        || memcmp(k->public_key, k->vehicles[agent_id], KEY) != 0)
        return fail(fault, STATUS_WRONG, "The bundle is not that of agent %u.", a->m.agent_id);
    const uint8_t *seals_to = mission_depot(&a->m);
    k->seals = seals_to != NULL;
    if (k->seals && (!k->has_depot || memcmp(seals_to, k->depot, KEY) != 0))
        return fail(fault, STATUS_WRONG, "The bundle seals to another depot than initial_data names.");
    if (k->seals && a->m.settings.max_block_bytes > MAX_EVENT_DATA - SEALED_EVENTS)
        return fail(fault, STATUS_WRONG, "Sealed events leave 976 for max_block_bytes.");
    uint32_t started = member(j, bundle, "started_us");
    k->is_first = started == 0;
    if (started != 0 && !json_uint(j, started, 0, INT64_MAX, &k->bundle_us))
        return fail(fault, STATUS_WRONG, "started_us of the bundle is no time.");
    k->first = k->epoch;
    return true;
}

/* The bundle anew, with the secret of this epoch alone. */
static void put_bundle(Buf *b, Json *j, uint32_t bundle, const Keys *k) {
    const char *comma = "{";
    for (uint32_t i = bundle + 1; i < j->node[bundle].end; i = j->node[i + 1].end) {
        if (says(j, i, "group_secret") || says(j, i, "epoch") || says(j, i, "started_us")) continue;
        const Node *key = &j->node[i], *value = key + 1;
        put_text(b, comma);
        put_ascii(b, (const uint8_t *)j->text + key->at - 1, value->at + value->len + (value->kind == '"') - key->at + 1);
        comma = ",";
    }
    put_text(b, ",\"group_secret\":\"");
    put_hex(b, k->secret, KEY);
    put_format(b, "\",\"epoch\":%" PRIu64 ",\"started_us\":%" PRIu64 "}\n", k->epoch, read_be(k->boot, 8));
}

/* --- Epochs ------------------------------------------------------------------------------------------------------ */

static void next_secret(const Keys *k, uint8_t secret[KEY]) {
    uint8_t next[KEY];
    Buf info = {0};
    put_tag(&info, "UCP epoch", k);
    expand(secret, &info, next, KEY);
    memcpy(secret, next, KEY);
    OPENSSL_cleanse(next, KEY);
    free(info.data);
}

static void advance(Keys *k, uint64_t epoch) {          /* only its own clock erases secrets */
    for (; k->epoch < epoch; k->epoch++) {
        memcpy(k->before, k->secret, KEY);
        k->has_before = k->moved = true;
        if (k->later.len > 0) {
            memcpy(k->secret, k->later.data, KEY);
            k->later.len -= KEY;
            memmove(k->later.data, k->later.data + KEY, k->later.len);
        } else {
            next_secret(k, k->secret);
        }
    }
}

static void follow(Keys *k, uint64_t epoch) {           /* others send in this epoch */
    uint64_t most = k->epoch + FOLLOWED, to = epoch < most ? epoch : most;
    k->followed = to > k->followed ? to : k->followed;
}

static uint64_t current(const Keys *k) { return k->followed > k->epoch ? k->followed : k->epoch; }

static bool keys_moved(Agent *a) {                      /* whether the bundle has to be written anew; asked once */
    bool moved = a->keys->moved;
    a->keys->moved = false;
    return moved;
}

static bool keys_seals(const Agent *a) { return a->keys->seals; }

static void look_at(Keys *k, double now) {
    if (k->has_begun && now < k->until_s) return;
    if (!k->has_begun) {
        k->has_begun = true;
        k->begun_s = now;
        k->complete = k->is_first && fabs(now) < k->epoch_s;
    }
    double shown = floor(now / k->epoch_s), since = floor((now - k->begun_s) / k->epoch_s);
    double epoch = shown > (double)k->first + since ? shown : (double)k->first + since;
    if (epoch > (double)k->epoch)
        advance(k, epoch >= UINT32_MAX ? UINT32_MAX : (uint64_t)epoch);
    double by_clock = (shown + 1) * k->epoch_s, by_start = k->begun_s + (since + 1) * k->epoch_s;
    k->until_s = by_clock < by_start ? by_clock : by_start;
}

static bool can_open(const Keys *k, uint64_t epoch) {
    if (epoch >= k->epoch) return epoch <= k->epoch + AHEAD;
    return epoch + 1 == k->epoch && k->has_before;
}

typedef struct { uint8_t key[KEY], iv[NONCE]; } Sender;

static const uint8_t *secret_of(Keys *k, uint64_t epoch) {
    if (epoch < k->epoch) return k->before;
    while (k->later.len < (epoch - k->epoch) * KEY) {
        uint8_t secret[KEY];
        memcpy(secret, k->later.len > 0 ? k->later.data + k->later.len - KEY : k->secret, KEY);
        next_secret(k, secret);
        put(&k->later, secret, KEY);
        OPENSSL_cleanse(secret, KEY);
    }
    return epoch == k->epoch ? k->secret : k->later.data + (epoch - k->epoch - 1) * KEY;
}

static Sender sender_keys(Keys *k, uint64_t epoch, uint32_t sender, const uint8_t boot[BOOT]) {
    Sender made;
    Buf info = {0};
    put_tag(&info, "UCP sender", k);
    put_be(&info, epoch, 4);
    put_be(&info, sender, 4);
    put(&info, boot, BOOT);
    expand(secret_of(k, epoch), &info, (uint8_t *)&made, sizeof made);
    free(info.data);
    return made;
}

static void nonce_of(const Sender *s, int type, uint32_t sequence, uint8_t nonce[NONCE]) {
    memcpy(nonce, s->iv, NONCE);
    write_be(nonce + 4, read_be(s->iv + 4, 4) ^ (type >= REVOCATION), 4);
    write_be(nonce + 8, read_be(s->iv + 8, 4) ^ sequence, 4);
}

/* --- Blocks: signed by their makers, events sealed to the depot --------------------------------------------------- */

static Signed *signature_at(const Keys *k, const Hash *block) {
    for (size_t i = k->held_len; i-- > 0;)
        if (same(&k->held[i].block, block)) return &k->held[i];
    return NULL;
}

static void keys_hold(Agent *a, const Hash *block, const uint8_t signature[SIGNATURE]) {
    Keys *k = a->keys;
    if (signature_at(k, block) != NULL) return;
    if (k->held_len == k->held_cap)
        k->held = grow(k->held, (k->held_cap = 2 * k->held_cap + 32) * sizeof *k->held);
    k->held[k->held_len].block = *block;
    memcpy(k->held[k->held_len++].signature, signature, SIGNATURE);
    if (a->keeping) {
        put_byte(&a->journal, SIGNED);
        put(&a->journal, block->b, 32);
        put(&a->journal, signature, SIGNATURE);
    }
}

static void put_block_claim(Buf *b, const Keys *k, const uint8_t *data, size_t n) {
    put_tag(b, "UCP block", k);
    put(b, data, n);
}

/* Its maker's, NULL if there is none; its own it signs now at the latest. */
static const uint8_t *keys_signature(Agent *a, const uint8_t *data, size_t n) {
    Hash hash = H(data, n);
    Signed *held = signature_at(a->keys, &hash);
    if (held == NULL && read_be(data, 4) == a->m.agent_id) {
        uint8_t signature[SIGNATURE];
        Buf claim = {0};
        put_block_claim(&claim, a->keys, data, n);
        sign(a->keys->private_key, &claim, signature);
        keys_hold(a, &hash, signature);
        free(claim.data);
        held = signature_at(a->keys, &hash);
    }
    return held == NULL ? NULL : held->signature;
}

static void put_labeled(Buf *b, bool kem, const char *label) {         /* HPKE-v1, the suite, the label (RFC 9180) */
    put_text(b, "HPKE-v1");
    put(b, kem ? "KEM\0\x20" : "HPKE\0\x20\0\1\0\3", kem ? 5 : 10);
    put_text(b, label);
}

static void extract(bool kem, const uint8_t *salt, const char *label, const uint8_t *secret, size_t n,
                    uint8_t out[32]) {
    static const uint8_t none[KEY];
    Buf in = {0};
    put_labeled(&in, kem, label);
    put(&in, secret, n);
    hmac(salt != NULL ? salt : none, KEY, &in, out);
    free(in.data);
}

static void expand_labeled(bool kem, const uint8_t secret[KEY], const char *label, const Buf *context, uint8_t *out,
                           size_t n) {
    Buf in = {0};
    put_be(&in, n, 2);
    put_labeled(&in, kem, label);
    put(&in, context->data, context->len);
    expand(secret, &in, out, n);
    free(in.data);
}

/* HPKE in base mode, to the depot: enc, ciphertext, tag. In virtual time the ephemeral key follows from
   all that it is used for; else it is random, so that nobody with the private key can confirm a guess. */
static size_t keys_seal_events(Agent *a, uint64_t timestamp, uint8_t *out) {
    Keys *k = a->keys;
    uint8_t ephemeral[KEY], dh[KEY], secret[KEY], key[KEY], nonce[NONCE], hash[KEY];
    Buf info = {0}, in = {0};
    put_tag(&info, "UCP event data", k);
    put_be(&info, a->m.agent_id, 4);
    put_be(&info, timestamp, 8);
    put(&in, "UCP ephemeral key", 18);
    put(&in, k->depot, KEY);
    put(&in, info.data, info.len);
    put(&in, a->current, a->current_len);
    hmac(k->private_key, KEY, &in, ephemeral);
    if (k->draws && getrandom(ephemeral, KEY, 0) != KEY)
        abort();
    if (!public_of(EVP_PKEY_X25519, ephemeral, out) || !agree(ephemeral, k->depot, dh))
        abort();                                        /* to this depot nobody can seal */
    in.len = 0;
    put(&in, out, KEY);
    put(&in, k->depot, KEY);
    extract(true, NULL, "eae_prk", dh, KEY, secret);
    expand_labeled(true, secret, "shared_secret", &in, dh, KEY);
    in.len = 0;
    put_byte(&in, 0);                                   /* base mode */
    extract(false, NULL, "psk_id_hash", NULL, 0, hash);
    put(&in, hash, KEY);
    extract(false, NULL, "info_hash", info.data, info.len, hash);
    put(&in, hash, KEY);
    extract(false, dh, "secret", NULL, 0, secret);
    expand_labeled(false, secret, "key", &in, key, KEY);
    expand_labeled(false, secret, "base_nonce", &in, nonce, NONCE);
    encrypt(key, nonce, a->current, a->current_len, NULL, 0, out + KEY);
    OPENSSL_cleanse(ephemeral, KEY);
    OPENSSL_cleanse(key, KEY);
    free(info.data);
    free(in.data);
    return a->current_len + SEALED_EVENTS;
}

/* --- Revocations ------------------------------------------------------------------------------------------------- */

static void tell(Keys *k, double now) {                 /* somebody may not know all revoked agents */
    if (k->digest == 0 || (k->has_told && now < k->told_at + TELL_AGAIN_S)) return;
    k->tells = k->has_told = true;
    k->told_at = now;
}

static size_t listed(const uint8_t *body, size_t n) {   /* the number of agents in a body, 0 if it is none */
    size_t count = n < 4 ? 0 : (size_t)read_be(body + 2, 2);
    return count <= MAX_REVOKED && n == 4 + 4 * count + SIGNATURE ? count : 0;
}

/* Whether each agent that a body lists is revoked, or is listed by another body if there is one. */
static bool adds_nothing(const Keys *k, const uint8_t *body, size_t n, const uint8_t *other, size_t other_n) {
    size_t count = listed(body, n), others = other != NULL ? listed(other, other_n) : 0;
    for (size_t i = 0; i < count; i++) {
        uint64_t id = read_be(body + 4 + 4 * i, 4);
        bool known = other == NULL && id < AGENT_IDS && k->revoked[id];
        for (size_t at = 0; at < others && !known; at++)
            known = read_be(other + 4 + 4 * at, 4) == id;
        if (!known) return false;
    }
    return count > 0;
}

static bool revocation_good(const Keys *k, const uint8_t *body, size_t n) {
    if (n < 4 + SIGNATURE || read_be(body, 2) == 0) return false;
    size_t count = (size_t)read_be(body + 2, 2), end = 4 + 4 * count;
    if (count < 1 || count > MAX_REVOKED || n != end + SIGNATURE) return false;
    for (size_t i = 0; i < count; i++) {
        uint64_t id = read_be(body + 4 + 4 * i, 4);
        if (id < 1 || id >= AGENT_IDS || (i > 0 && id <= read_be(body + 4 * i, 4))) return false;
    }
    Buf claim = {0};
    put_tag(&claim, "UCP revocation", k);
    put(&claim, body, end);
    bool good = verify(k->authority, &claim, body + end);
    free(claim.data);
    return good;
}

static void take_over(Keys *k, const uint8_t *body, size_t n) {        /* a good revocation that lists a further agent */
    Buf kept = {0}, ids = {0};
    for (size_t at = 0; at < k->revocations.len;) {
        const uint8_t *held = k->revocations.data + at + 2;
        size_t size = (size_t)read_be(held - 2, 2);
        if (!adds_nothing(k, held, size, body, n))
            put(&kept, held - 2, 2 + size);
        at += 2 + size;
    }
    put_be(&kept, n, 2);
    put(&kept, body, n);
    free(k->revocations.data);
    k->revocations = kept;
    for (size_t i = 0; i < listed(body, n); i++)
        k->revoked[read_be(body + 4 + 4 * i, 4)] = true;
    for (size_t id = 1; id < AGENT_IDS; id++)
        if (k->revoked[id])
            put_be(&ids, id, 4);
    Hash hash = H(ids.data, ids.len);
    k->digest = read_be(hash.b, 2);
    if (k->digest == 0)
        k->digest = 1;
    free(ids.data);
}

/* GOOD if it lists a further agent. */
static enum drop keys_revoke(Agent *a, double now, const uint8_t *body, size_t n) {
    Keys *k = a->keys;
    if (adds_nothing(k, body, n, NULL, 0)) return KNOWN_ALREADY;
    if (!revocation_good(k, body, n)) return NOT_THE_AUTHORITY;
    take_over(k, body, n);
    k->has_told = false;
    tell(k, now);
    if (a->keeping) {
        put_byte(&a->journal, REVOKED);
        put_be(&a->journal, n, 2);
        put(&a->journal, body, n);
    }
    return GOOD;
}

static int requested_by(int response) {                 /* the type of what it answers; 0: it answers nothing */
    return response == BLOCK_ADD_RESPONSE || response == CHAIN_CONTAIN_RESPONSE || response == BLOCK_RESPONSE
        || response == NEXT_IN_SEQUENCE_RESPONSE ? response - 1 : 0;
}

static bool is_request(int type) { return type < REVOCATION && requested_by(type + 1) != 0; }

/* --- From the air ------------------------------------------------------------------------------------------------ */

static bool is_fresh(const Life *life, uint32_t sequence) {
    if ((int64_t)sequence > life->newest) return true;
    return (int64_t)sequence > life->newest - WINDOW && !(life->word[sequence / 64 % WORDS] >> sequence % 64 & 1);
}

static void accept_sequence(Life *life, uint32_t sequence) {
    int64_t word = sequence / 64, newest = life->newest < 0 ? -1 : life->newest / 64;
    if ((int64_t)sequence > life->newest) {
        for (int64_t i = 0; i < word - newest && i < WORDS; i++)
            life->word[(word - i) % WORDS] = 0;
        life->newest = sequence;
    }
    life->word[word % WORDS] |= (uint64_t)1 << sequence % 64;
}

static Life *life_new(Life *old, const uint8_t boot[BOOT], uint32_t first, const uint8_t *latest) {
    Life *life = old != NULL ? old : grow(NULL, sizeof *life);
    bool later = latest != NULL && memcmp(latest, boot, BOOT) > 0;
    uint8_t greatest[BOOT];
    memcpy(greatest, later ? latest : boot, BOOT);      /* `latest` may be of `old` */
    *life = (Life){.newest = (int64_t)first - 1};
    memset(life->word, first > 0 ? 0xff : 0, sizeof life->word);
    memcpy(life->boot, boot, BOOT);
    memcpy(life->latest, greatest, BOOT);
    return life;
}

static bool is_boot(const Life *life, const uint8_t boot[BOOT]) { return memcmp(boot, life->boot, BOOT) == 0; }

static bool is_later(const Life *life, const uint8_t boot[BOOT]) { return memcmp(boot, life->latest, BOOT) > 0; }

/* --- Challenges: whether a sender exists now ---------------------------------------------------------------------- */

static Challenge *challenge_of(Keys *k, uint32_t agent) {
    if (k->challenges[agent] == NULL)
        memset(k->challenges[agent] = grow(NULL, sizeof(Challenge)), 0, sizeof(Challenge));
    return k->challenges[agent];
}

static void challenge(Keys *k, uint32_t target, double now) {
    Challenge *c = challenge_of(k, target);
    if (!c->has_sent || now >= c->sent_at + CHALLENGE_AGAIN_S)
        c->due = true;
}

static Life *accept_boot(Keys *k, const Opened *o) {    /* later than all known ones: older challenges do not count */
    challenge_of(k, o->sender)->counts_from = k->control;
    return k->lives[o->sender] = life_new(k->lives[o->sender], o->boot, 0, NULL);
}

static bool is_new_challenge(Challenge *c, const Opened *o) {
    for (size_t i = 0; i < c->received.len; i += BOOT + 4)
        if (memcmp(c->received.data + i, o->boot, BOOT) == 0)
            return o->sequence > read_be(c->received.data + i + BOOT, 4);
    return true;
}

static void add_challenge(Challenge *c, const Opened *o) {
    size_t i = 0;
    while (i < c->received.len && memcmp(c->received.data + i, o->boot, BOOT) != 0)
        i += BOOT + 4;
    if (i == c->received.len) {
        if (i == (size_t)MAX_CHALLENGED * (BOOT + 4)) { /* forget the first one */
            c->received.len = i -= BOOT + 4;
            memmove(c->received.data, c->received.data + BOOT + 4, i);
        }
        put(&c->received, o->boot, BOOT);
        put_be(&c->received, o->sequence, 4);
    } else
        write_be(c->received.data + i + BOOT, o->sequence, 4);
}

static bool is_pending(Keys *k, uint32_t target, uint32_t sequence) {
    return k->challenges[target] != NULL && k->challenges[target]->has_sent && k->challenges[target]->sequence == sequence;
}

static void trust_waiting(Keys *k, double now) {
    size_t answered = 0;
    for (size_t i = 1; i < AGENT_IDS; i++)
        answered += k->waiting[i] != NULL || k->lives[i] != NULL;
    bool collects = !k->complete && k->has_challenged && now < k->challenged_at + TRUST_AFTER_S;
    if (collects && answered != k->vehicles_len - 1) return;
    for (size_t i = 1; i < AGENT_IDS; i++)
        if (k->waiting[i] != NULL) {
            free(k->lives[i]);
            k->lives[i] = k->waiting[i];
            k->waiting[i] = NULL;
        }
}

static bool opens(Keys *k, const Opened *o, uint64_t epoch, const uint8_t *d, size_t n, uint8_t *body) {
    uint8_t nonce[NONCE];
    Sender keys = sender_keys(k, epoch, o->sender, o->boot);
    nonce_of(&keys, o->type, o->sequence, nonce);
    return decrypt(keys.key, nonce, d + CLEAR, n - CLEAR, d, CLEAR, body);
}

static bool is_signed(const Keys *k, const Opened *o, const uint8_t *d, const uint8_t *body, size_t size) {
    Buf claim = {0};
    put_tag(&claim, "UCP datagram", k);
    put(&claim, d, CLEAR);
    put(&claim, body, size);
    bool good = verify(k->vehicles[o->sender], &claim, body + size);
    free(claim.data);
    return good;
}

static enum drop take_challenge(Agent *a, const Opened *o, uint64_t epoch, const uint8_t *d, size_t n) {
    Keys *k = a->keys;
    uint8_t body[MAX_DATAGRAM];
    Life *life = k->lives[o->sender];
    Challenge *c = challenge_of(k, o->sender);
    if (!is_new_challenge(c, o)) return REPLAYED;
    if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
    if (!is_signed(k, o, d, body, n - CLEAR - SEAL)) return NOT_THE_SENDER;
    if (n != CLEAR + SEAL + 4) return WRONG_LENGTH;
    add_challenge(c, o);
    if (life == NULL ? k->complete : is_later(life, o->boot))
        accept_boot(k, o);
    follow(k, epoch);
    uint64_t target = read_be(body, 4);
    if (target == ALL || target == a->m.agent_id) {
        put_be(&k->echoes, o->sender, 4);
        put(&k->echoes, o->boot, BOOT);
        put_be(&k->echoes, o->sequence, 4);
    }
    k->has_told = false;                                /* it waits for revocations before it trusts others */
    return GOOD;
}

static enum drop take_echo(Agent *a, double now, const Opened *o, uint64_t epoch, const uint8_t *d, size_t n) {
    Keys *k = a->keys;
    uint8_t body[MAX_DATAGRAM];
    if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
    if (n != CLEAR + SEAL + ASKED_BY + 4) return WRONG_LENGTH;
    uint32_t sequence = (uint32_t)read_be(body + 20, 4);
    if (read_be(body, 4) != a->m.agent_id || memcmp(body + 4, k->boot, BOOT) != 0
        || !(is_pending(k, ALL, sequence) || is_pending(k, o->sender, sequence))
        || sequence < challenge_of(k, o->sender)->counts_from)
        return ANSWERS_NO_REQUEST;
    if (!is_signed(k, o, d, body, ASKED_BY + 4)) return NOT_THE_SENDER;
    challenge_of(k, o->sender)->counts_from = k->control;
    follow(k, epoch);
    Life *known = k->lives[o->sender];
    if (known == NULL || !is_boot(known, o->boot)) {
        k->waiting[o->sender] = life_new(k->waiting[o->sender], o->boot, (uint32_t)read_be(body + ASKED_BY, 4),
                                         known != NULL ? known->latest : NULL);
        trust_waiting(k, now);
    }
    return GOOD;
}

/* Up to where nothing changes. GOOD: `plain` is the datagram of version 1; or the body of a revocation, which is taken;
   or it was a challenge or an echo, which is dealt with. */
static enum drop keys_open(Agent *a, double now, const uint8_t *d, size_t n, Buf *plain, Opened *o) {
    Keys *k = a->keys;
    look_at(k, now);
    if (n < 4) return TRUNCATED;
    if (n > MAX_DATAGRAM) return OVERSIZED;
    if (d[0] != 'U' || d[1] != 'C') return WRONG_MAGIC;
    if (d[2] != 3) return d[2] == 1 ? NOT_SECURED : WRONG_VERSION;
    if (n < CLEAR) return TRUNCATED;
    o->type = d[3];
    o->sender = (uint32_t)read_be(d + 4, 4);
    o->sequence = (uint32_t)read_be(d + 8, 4);
    uint64_t epoch = read_be(d + 14, 4);
    memcpy(o->boot, d + 18, BOOT);
    o->revocations = read_be(d + 34, 2);
    if (o->sender < 1 || o->sender >= AGENT_IDS) return IMPOSSIBLE_SENDER;
    if (read_be(d + 12, 2) != n - CLEAR) return WRONG_LENGTH;
    if (o->type < 1 || o->type > ECHO) return UNKNOWN_TYPE;
    if (n < (size_t)CLEAR + (o->type == REVOCATION ? TAG : SEAL)) return WRONG_LENGTH;
    if (o->sender == a->m.agent_id) return OWN_SENDER;
    if (!set_has(&a->roster, (uint16_t)o->sender)) return STRANGER;
    if (o->type != REVOCATION && k->revoked[o->sender]) return REVOKED_SENDER;
    if (o->type < REVOCATION)
        trust_waiting(k, now);

    uint8_t body[MAX_DATAGRAM];
    if (!can_open(k, epoch)) return EPOCH_OUT_OF_RANGE;
    if (o->type == REVOCATION) {
        if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
        put(plain, body, n - CLEAR - TAG);
        return keys_revoke(a, now, body, n - CLEAR - TAG);
    }
    if (o->type > REVOCATION) {
        enum drop drop = o->type == CHALLENGE ? take_challenge(a, o, epoch, d, n) : take_echo(a, now, o, epoch, d, n);
        if (drop == GOOD && o->revocations != k->digest)
            tell(k, now);
        return drop;
    }
    Life *life = k->lives[o->sender];
    if (life == NULL && !k->complete) {
        if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
        follow(k, epoch);
        challenge(k, ALL, now);
        return NOT_CONFIRMED;
    }
    if (life != NULL && !is_boot(life, o->boot) && !is_later(life, o->boot)) {
        if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
        challenge(k, o->sender, now);
        return OLD_BOOT;
    }
    if (life != NULL && is_boot(life, o->boot) && !is_fresh(life, o->sequence)) return REPLAYED;
    size_t size = n - CLEAR - SEAL;
    if (!opens(k, o, epoch, d, n, body)) return NOT_AUTHENTIC;
    if (!is_signed(k, o, d, body, size)) return NOT_THE_SENDER;

    if (life == NULL || !is_boot(life, o->boot))
        life = accept_boot(k, o);
    accept_sequence(life, o->sequence);
    follow(k, epoch);
    if (is_request(o->type) && life->asked[o->type] < o->sequence)
        life->asked[o->type] = o->sequence;

    const uint8_t *at = body;
    bool answers = requested_by(o->type) != 0, carries = o->type == COMMIT_BLOCK || o->type == BLOCK_RESPONSE;
    if (answers) {
        if (size < ASKED_BY) return WRONG_LENGTH;
        o->request.sender = (uint32_t)read_be(at, 4);
        memcpy(o->request.boot, at + 4, BOOT);
        o->request.sequence = (uint32_t)read_be(at + 20, 4);
        at += ASKED_BY;
        size -= ASKED_BY;
    }
    if (carries) {
        if (size < SIGNATURE) return WRONG_LENGTH;
        size -= SIGNATURE;
        memcpy(o->signature, at + size, SIGNATURE);
    }
    put(plain, "UC\1", 3);
    put_byte(plain, (uint8_t)o->type);
    put_be(plain, o->sender, 4);
    put_be(plain, o->sequence, 4);
    put_be(plain, size, 2);
    put(plain, at, size);
    return GOOD;
}

static bool is_asked(const Agent *a, const Request *r, int asking) {
    const Keys *k = a->keys;
    if (r->sender == a->m.agent_id)
        return memcmp(r->boot, k->boot, BOOT) == 0 && k->has_asked[asking] && r->sequence == k->asked[asking];
    if (r->sender < 1 || r->sender >= AGENT_IDS || k->vehicles[r->sender] == NULL) return false;
    const Life *life = k->lives[r->sender];
    return life == NULL || is_later(life, r->boot) || (is_boot(life, r->boot) && r->sequence >= life->asked[asking]);
}

/* What is authentic, and must not be handled all the same. */
static enum drop keys_allow(Agent *a, double now, const Opened *o, const Input *in, enum drop drop) {
    Keys *k = a->keys;
    if (drop != GOOD && drop != STRANGERS_BLOCK) return drop;
    if (o->revocations != k->digest)
        tell(k, now);
    if (drop != GOOD) return drop;
    int asking = requested_by(o->type);
    if (asking != 0 && !is_asked(a, &o->request, asking)) return ANSWERS_NO_REQUEST;
    if (in->data == NULL) return GOOD;
    Hash hash = H(in->data, in->data_len);
    if (signature_at(k, &hash) != NULL || (read_be(in->data, 4) == a->m.agent_id && holds(a, &hash))) return GOOD;
    Buf claim = {0};
    put_block_claim(&claim, k, in->data, in->data_len);
    bool good = verify(k->vehicles[read_be(in->data, 4)], &claim, o->signature);
    free(claim.data);
    return good ? GOOD : NOT_THE_MAKER;
}

/* It has looked at the message: of a block that it took it keeps the signature. */
static void keys_keep(Agent *a, const Opened *o, const Input *in) {
    if (in->data == NULL) return;
    Hash hash = H(in->data, in->data_len);
    if (holds(a, &hash))
        keys_hold(a, &hash, o->signature);
}

/* --- To the air: once an input is over, all that is to be sent is sealed; answers name what they answer. ----------- */

static void put_clear(Buf *b, const Agent *a, int type, uint32_t sequence, size_t behind) {
    const Keys *k = a->keys;
    put(b, "UC\3", 3);
    put_byte(b, (uint8_t)type);
    put_be(b, a->m.agent_id, 4);
    put_be(b, sequence, 4);
    put_be(b, behind, 2);
    put_be(b, current(k), 4);
    put(b, k->boot, BOOT);
    put_be(b, k->digest, 2);
}

/* A datagram with this body, signed and sealed, behind its length. A revocation has the authority's signature alone. */
static void put_sealed(Buf *out, Agent *a, int type, uint32_t sequence, const Buf *body) {
    Keys *k = a->keys;
    Buf clear = {0}, plain = {0}, claim = {0};
    uint8_t nonce[NONCE], signature[SIGNATURE];
    put(&plain, body->data, body->len);
    put_clear(&clear, a, type, sequence, body->len + (type == REVOCATION ? TAG : SEAL));
    if (type != REVOCATION) {
        put_tag(&claim, "UCP datagram", k);
        put(&claim, clear.data, clear.len);
        put(&claim, body->data, body->len);
        sign(k->private_key, &claim, signature);
        put(&plain, signature, SIGNATURE);
    }
    Sender keys = sender_keys(k, current(k), a->m.agent_id, k->boot);
    nonce_of(&keys, type, sequence, nonce);
    put_be(out, CLEAR + plain.len + TAG, 2);
    put(out, clear.data, clear.len);
    buf_room(out, plain.len + TAG);
    encrypt(keys.key, nonce, plain.data, plain.len, clear.data, CLEAR, out->data + out->len);
    out->len += plain.len + TAG;
    free(clear.data);
    free(plain.data);
    free(claim.data);
}

static bool has_control(const Keys *k) {
    if (k->tells || k->echoes.len > 0) return true;
    for (size_t i = 0; i < AGENT_IDS; i++)
        if (k->challenges[i] != NULL && k->challenges[i]->due) return true;
    return false;
}

static void put_control(Buf *out, Agent *a) {           /* revocations, challenges, echoes */
    Keys *k = a->keys;
    Buf body = {0};
    for (size_t at = 0; k->tells && at < k->revocations.len; at += 2 + body.len) {
        body.len = 0;
        put(&body, k->revocations.data + at + 2, (size_t)read_be(k->revocations.data + at, 2));
        put_sealed(out, a, REVOCATION, k->control++, &body);
    }
    k->tells = false;
    if (!k->complete && !k->has_challenged)
        challenge(k, ALL, a->now);
    for (uint32_t target = 0; target < AGENT_IDS; target++) {
        Challenge *c = k->challenges[target];
        if (c == NULL || !c->due) continue;
        c->due = false;
        c->has_sent = true;
        c->sent_at = a->now;
        c->sequence = k->control;
        if (target == ALL && !k->has_challenged) {
            k->has_challenged = true;
            k->challenged_at = a->now;
        }
        body.len = 0;
        put_be(&body, target, 4);
        put_sealed(out, a, CHALLENGE, k->control++, &body);
    }
    for (size_t at = 0; at < k->echoes.len; at += ASKED_BY) {
        body.len = 0;
        put(&body, k->echoes.data + at, ASKED_BY);
        put_be(&body, k->next, 4);
        put_sealed(out, a, ECHO, k->control++, &body);
    }
    k->echoes.len = 0;
    free(body.data);
}

static void seal(Agent *a, Buf *out, const uint8_t *plain, size_t n, const Opened *heard) {
    Keys *k = a->keys;
    int type = plain[3], asking = requested_by(type);
    uint32_t sequence = (uint32_t)read_be(plain + 8, 4);
    const uint8_t *body = plain + HEADER;
    size_t size = n - HEADER;
    Buf sealed = {0};
    if (sequence >= k->next)
        k->next = sequence + 1;
    if (is_request(type)) {
        k->has_asked[type] = true;
        k->asked[type] = sequence;
    }
    if (asking != 0) {
        static const uint8_t nobody[ASKED_BY];
        if (heard != NULL && heard->type == asking) {
            put_be(&sealed, heard->sender, 4);
            put(&sealed, heard->boot, BOOT);
            put_be(&sealed, heard->sequence, 4);
        } else {
            put(&sealed, nobody, ASKED_BY);
        }
    }
    put(&sealed, body, size);
    if (type == COMMIT_BLOCK || type == BLOCK_RESPONSE) {
        static const uint8_t unsigned_block[SIGNATURE];
        size_t before = type == COMMIT_BLOCK ? 32 : 0;
        const uint8_t *signature = keys_signature(a, body + before, size - before);
        put(&sealed, signature != NULL ? signature : unsigned_block, SIGNATURE);
    }
    put_sealed(out, a, type, sequence, &sealed);
    free(sealed.data);
}

static void keys_seal(Agent *a, const Opened *heard) {
    Keys *k = a->keys;
    Buf out = {0};
    if (a->out.len == 0 && !has_control(k)) return;
    look_at(k, a->now);
    put_control(&out, a);
    for (size_t at = 0; at < a->out.len;) {
        size_t n = (size_t)read_be(a->out.data + at, 2);
        seal(a, &out, a->out.data + at + 2, n, heard);
        at += 2 + n;
    }
    a->out.len = 0;
    put(&a->out, out.data, out.len);
    free(out.data);
}

/* --- The store: what is kept beside what every agent keeps --------------------------------------------------------- */

static uint64_t started_us(const Keys *k) { return read_be(k->boot, 8); }

static void put_lived(Buf *b, const Keys *k) {
    put_byte(b, LIVED);
    put_be(b, started_us(k), 8);
}

static void put_keys_store(Buf *b, Agent *a) {
    Keys *k = a->keys;
    put_lived(b, k);
    for (size_t i = 0; i < k->held_len; i++) {
        put_byte(b, SIGNED);
        put(b, k->held[i].block.b, 32);
        put(b, k->held[i].signature, SIGNATURE);
    }
    for (size_t at = 0; at < k->revocations.len;) {
        size_t size = 2 + (size_t)read_be(k->revocations.data + at, 2);
        put_byte(b, REVOKED);
        put(b, k->revocations.data + at, size);
        at += size;
    }
}

/* One of these records; how long it is, 0 if it is none. */
static size_t keys_replay(Agent *a, int what, const uint8_t *at, size_t n) {
    Keys *k = a->keys;
    if (what == LIVED && n >= 8) {
        uint64_t us = read_be(at, 8);
        k->lived_us = us > k->lived_us ? us : k->lived_us;
        return 8;
    }
    if (what == SIGNED && n >= 32 + SIGNATURE) {
        Hash block;
        memcpy(block.b, at, 32);
        keys_hold(a, &block, at + 32);
        return 32 + SIGNATURE;
    }
    if (what == REVOKED && n >= 2 && n - 2 >= read_be(at, 2)) {
        size_t size = (size_t)read_be(at, 2);
        if (revocation_good(k, at + 2, size) && !adds_nothing(k, at + 2, size, NULL, 0))   /* of other keys: not */
            take_over(k, at + 2, size);
        return 2 + size;
    }
    return 0;
}

/* --- The export: a head that the agent signs ----------------------------------------------------------------------- */

static void put_digest(Buf *b, const char *name, const Hash *hash) {
    put_format(b, ",\"%s\":\"", name);
    put_hex(b, hash->b, 32);
    put_byte(b, '"');
}

static void put_head(Buf *b, Agent *a, uint64_t exported_at) {
    Keys *k = a->keys;
    uint8_t signature[SIGNATURE];
    Buf held = {0}, claim = {0}, ids = {0};
    const List *lists[] = {&a->deque, &a->stack};
    put_be(&held, a->deque.len, 4);
    put_be(&held, a->stack.len, 4);
    put_byte(&held, a->reconciling);
    put_byte(&held, is_idle(a));
    for (int l = 0; l < 2; l++)
        for (size_t i = 0; i < lists[l]->len; i++)
            put(&held, lists[l]->at[i]->hash.b, 32);
    put(&held, a->current, a->current_len);
    Hash completed = H(a->completed.data, a->completed.len), rest = H(held.data, held.len);
    for (size_t id = 1; id < AGENT_IDS; id++)
        if (k->revoked[id])
            put_be(&ids, id, 4);
    k->exports++;
    put_tag(&claim, "UCP export", k);
    put_be(&claim, a->m.agent_id, 4);
    put(&claim, k->boot, BOOT);
    put_be(&claim, k->exports, 4);
    put_be(&claim, exported_at, 8);
    put_be(&claim, a->chain.len, 4);
    put(&claim, a->top.b, 32);
    put(&claim, completed.b, 32);
    put(&claim, rest.b, 32);
    put_be(&claim, ids.len / 4, 2);
    put(&claim, ids.data, ids.len);
    sign(k->private_key, &claim, signature);
    put_text(b, ",\"head\":{\"mission\":\"");
    put_hex(b, k->mission, MISSION_ID);
    put_text(b, "\",\"boot\":\"");
    put_hex(b, k->boot, BOOT);
    put_format(b, "\",\"number\":%u,\"height\":%zu", k->exports, a->chain.len);
    put_digest(b, "top_chain_hash", &a->top);
    put_digest(b, "completed", &completed);
    put_digest(b, "held", &rest);
    put_text(b, ",\"revoked\":[");
    for (size_t at = 0; at < ids.len; at += 4)
        put_format(b, "%s%u", at > 0 ? "," : "", (unsigned)read_be(ids.data + at, 4));
    put_text(b, "],\"signature\":\"");
    put_base64(b, signature, SIGNATURE);
    put_text(b, "\"}");
    free(held.data);
    free(claim.data);
    free(ids.data);
}

/* On a vehicle: the life is later than the one before, whatever the clock says, and the bundle has to be written. */
static void keys_begin(Agent *a) {
    Keys *k = a->keys;
    if (!k->is_first && started_us(k) <= k->bundle_us)
        write_be(k->boot, k->bundle_us + 1, 8);
    k->draws = k->moved = true;
}

static void keys_boot(Agent *a) {                       /* this life is later than those before, whatever the clock says */
    Keys *k = a->keys;
    if (started_us(k) <= k->lived_us)
        write_be(k->boot, k->lived_us + 1, 8);
}
