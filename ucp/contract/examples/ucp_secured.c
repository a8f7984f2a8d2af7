/*
 * Keys for ucp_agent.c, which includes this file if it is compiled with -DSECURED and -lcrypto (OpenSSL 3): the
 * chapter "Secured missions" of ucp/contract/CONTRACT.md. A layer around the protocol, which knows nothing of it: what is heard
 * is opened before it is read, and what is to be sent is sealed once an input is over.
 */
#include <openssl/evp.h>
#include <openssl/hmac.h>

enum {
    KEY = 32, SIGNATURE = 64, TAG = 16, NONCE = 12, MISSION_ID = 16, BOOT = 16, CLEAR = 36, SEAL = TAG + SIGNATURE,
    ASKED_BY = 24, REVOCATION = 10, AHEAD = 8, WINDOW = 1024, WORDS = WINDOW / 64 + 1, MAX_REVOKED = 256,
    SEALED_EVENTS = KEY + TAG, TELL_AGAIN_S = 5
};

typedef struct { uint32_t sender, sequence; uint8_t boot[BOOT]; } Request;

typedef struct Opened {                                 /* what came, if it is authentic */
    int type;
    uint32_t sender, sequence;
    uint8_t boot[BOOT], signature[SIGNATURE];           /* signature: of the block that it carries */
    Request request;                                    /* that it answers */
    uint64_t revocations;
} Opened;

typedef struct {                                        /* of another sender: its newest life */
    uint8_t boot[BOOT];
    uint64_t word[WORDS];                               /* a ring: which sequence numbers have come (RFC 6479) */
    int64_t newest;
    uint32_t asked[REVOCATION];                         /* by type of a request: the newest sequence of it */
} Life;

typedef struct { Hash block; uint8_t signature[SIGNATURE]; } Signed;

struct Keys {
    uint8_t mission[MISSION_ID], authority[KEY], private_key[KEY], public_key[KEY], depot[KEY], boot[BOOT];
    bool has_depot, seals;
    double epoch_s;
    uint64_t epoch, clock;                              /* the current one, and that of its own clock */
    uint8_t secret[KEY], before[KEY];                   /* of the current epoch, and of the one before */
    bool has_before, moved;                             /* moved: the bundle on disk has an older secret */
    uint8_t *vehicles[AGENT_IDS];                       /* public keys, NULL of who has none */
    Life *lives[AGENT_IDS];
    bool has_asked[REVOCATION];
    uint32_t asked[REVOCATION];                         /* its own newest request of a type */
    Signed *held;                                       /* makers' signatures of blocks */
    size_t held_len, held_cap;
    Buf revocation;                                     /* the body of the newest, empty if there is none */
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
    }
    free(k->held);
    free(k->revocation.data);
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
        if (k->vehicles[id] == NULL)
            k->vehicles[id] = grow(NULL, KEY);
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
    k->clock = k->epoch;
    return true;
}

/* The bundle anew, with the secret of this epoch alone. */
static void put_bundle(Buf *b, Json *j, uint32_t bundle, const Keys *k) {
    const char *comma = "{";
    for (uint32_t i = bundle + 1; i < j->node[bundle].end; i = j->node[i + 1].end) {
        if (says(j, i, "group_secret") || says(j, i, "epoch")) continue;
        const Node *key = &j->node[i], *value = key + 1;
        put_text(b, comma);
        put_ascii(b, (const uint8_t *)j->text + key->at - 1, value->at + value->len + (value->kind == '"') - key->at + 1);
        comma = ",";
    }
    put_text(b, ",\"group_secret\":\"");
    put_hex(b, k->secret, KEY);
    put_format(b, "\",\"epoch\":%" PRIu64 "}\n", k->epoch);
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

static void follow(Keys *k, uint64_t epoch) {
    for (; k->epoch < epoch; k->epoch++) {
        memcpy(k->before, k->secret, KEY);
        k->has_before = k->moved = true;
        next_secret(k, k->secret);
    }
}

static bool keys_moved(Agent *a) {                      /* whether the bundle has to be written anew; asked once */
    bool moved = a->keys->moved;
    a->keys->moved = false;
    return moved;
}

static bool keys_seals(const Agent *a) { return a->keys->seals; }

static void look_at(Keys *k, double now) {
    double epoch = floor(now / k->epoch_s);
    k->clock = epoch <= 0 ? 0 : epoch >= UINT32_MAX ? UINT32_MAX : (uint64_t)epoch;
    if (k->clock > k->epoch)
        follow(k, k->clock);
}

static bool can_open(const Keys *k, uint64_t epoch) {
    if (epoch > k->epoch) return epoch <= k->clock + AHEAD;
    return epoch == k->epoch || (epoch + 1 == k->epoch && k->has_before);
}

typedef struct { uint8_t key[KEY], iv[NONCE], mask[KEY]; } Sender;

static Sender sender_keys(const Keys *k, uint64_t epoch, uint32_t sender, const uint8_t boot[BOOT]) {
    uint8_t secret[KEY];
    Sender made;
    Buf info = {0};
    memcpy(secret, epoch < k->epoch ? k->before : k->secret, KEY);
    for (uint64_t at = k->epoch; at < epoch; at++)
        next_secret(k, secret);
    put_tag(&info, "UCP sender", k);
    put_be(&info, epoch, 4);
    put_be(&info, sender, 4);
    put(&info, boot, BOOT);
    expand(secret, &info, (uint8_t *)&made, sizeof made);
    OPENSSL_cleanse(secret, KEY);
    free(info.data);
    return made;
}

static void nonce_of(const Sender *s, uint32_t sequence, uint8_t nonce[NONCE]) {
    memcpy(nonce, s->iv, NONCE);
    write_be(nonce + 8, read_be(s->iv + 8, 4) ^ sequence, 4);
}

static void mask(const Sender *s, uint32_t sequence, uint8_t signature[SIGNATURE]) {
    uint8_t stream[SIGNATURE];
    Buf info = {0};
    put(&info, "UCP signature mask", 19);
    put_be(&info, sequence, 4);
    expand(s->mask, &info, stream, SIGNATURE);
    for (int i = 0; i < SIGNATURE; i++)
        signature[i] ^= stream[i];
    free(info.data);
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

/* HPKE in base mode, to the depot: enc, ciphertext, tag. The ephemeral key comes of all that it is used for. */
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

static uint64_t revocations(const Keys *k) { return k->revocation.len > 0 ? read_be(k->revocation.data, 2) : 0; }

static void tell(Keys *k, double now) {                 /* somebody may not know of the newest */
    if (k->has_told && now < k->told_at + TELL_AGAIN_S) return;
    k->tells = k->has_told = true;
    k->told_at = now;
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

static void take_over(Keys *k, const uint8_t *body, size_t n) {        /* a revocation that is good */
    k->revocation.len = 0;
    put(&k->revocation, body, n);
    memset(k->revoked, 0, sizeof k->revoked);
    for (size_t i = 4; i + SIGNATURE < n; i += 4)
        k->revoked[read_be(body + i, 4)] = true;
}

/* GOOD if it is new. */
static enum drop keys_revoke(Agent *a, double now, const uint8_t *body, size_t n) {
    Keys *k = a->keys;
    uint64_t number = read_be(body, n < 2 ? (int)n : 2);
    if (number > 0 && number <= revocations(k)) return KNOWN_ALREADY;
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

/* Up to where nothing changes. GOOD: `plain` is the datagram of version 1; or it was a revocation, which is taken. */
static enum drop keys_open(Agent *a, double now, const uint8_t *d, size_t n, Buf *plain, Opened *o) {
    Keys *k = a->keys;
    look_at(k, now);
    if (n < 4) return TRUNCATED;
    if (n > MAX_DATAGRAM) return OVERSIZED;
    if (d[0] != 'U' || d[1] != 'C') return WRONG_MAGIC;
    if (d[2] != 2) return d[2] == 1 ? NOT_SECURED : WRONG_VERSION;
    if (n < CLEAR) return TRUNCATED;
    o->type = d[3];
    o->sender = (uint32_t)read_be(d + 4, 4);
    o->sequence = (uint32_t)read_be(d + 8, 4);
    uint64_t epoch = read_be(d + 14, 4);
    memcpy(o->boot, d + 18, BOOT);
    o->revocations = read_be(d + 34, 2);
    if (o->sender < 1 || o->sender >= AGENT_IDS) return IMPOSSIBLE_SENDER;
    if (read_be(d + 12, 2) != n - CLEAR) return WRONG_LENGTH;
    if (o->type < 1 || o->type > REVOCATION) return UNKNOWN_TYPE;
    if (o->type != REVOCATION && n < CLEAR + SEAL) return WRONG_LENGTH;
    if (o->sender == a->m.agent_id) return OWN_SENDER;
    if (!set_has(&a->roster, (uint16_t)o->sender)) return STRANGER;
    if (o->type == REVOCATION) return keys_revoke(a, now, d + CLEAR, n - CLEAR);
    if (k->revoked[o->sender]) return REVOKED_SENDER;

    Life *life = k->lives[o->sender];
    int later = life == NULL ? 1 : memcmp(o->boot, life->boot, BOOT);
    if (!can_open(k, epoch)) return EPOCH_OUT_OF_RANGE;
    if (later < 0) return OLD_BOOT;
    if (later == 0 && !is_fresh(life, o->sequence)) return REPLAYED;
    uint8_t body[MAX_DATAGRAM], nonce[NONCE], signature[SIGNATURE];
    size_t size = n - CLEAR - SEAL;
    Sender keys = sender_keys(k, epoch, o->sender, o->boot);
    nonce_of(&keys, o->sequence, nonce);
    if (!decrypt(keys.key, nonce, d + CLEAR, size + TAG, d, CLEAR, body)) return NOT_AUTHENTIC;
    memcpy(signature, d + n - SIGNATURE, SIGNATURE);
    mask(&keys, o->sequence, signature);
    Buf claim = {0};
    put_tag(&claim, "UCP datagram", k);
    put(&claim, d, n - SIGNATURE);
    bool good = verify(k->vehicles[o->sender], &claim, signature);
    free(claim.data);
    if (!good) return NOT_THE_SENDER;

    if (later != 0) {
        if (life == NULL)
            life = k->lives[o->sender] = grow(NULL, sizeof *life);
        *life = (Life){.newest = -1};
        memcpy(life->boot, o->boot, BOOT);
    }
    accept_sequence(life, o->sequence);
    if (epoch > k->epoch)
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
    int later = life == NULL ? 1 : memcmp(r->boot, life->boot, BOOT);
    return later > 0 || (later == 0 && r->sequence >= life->asked[asking]);
}

/* What is authentic, and must not be handled all the same. */
static enum drop keys_allow(Agent *a, double now, const Opened *o, const Input *in, enum drop drop) {
    Keys *k = a->keys;
    if (drop != GOOD && drop != STRANGERS_BLOCK) return drop;
    if (o->revocations < revocations(k))
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
    put(b, "UC\2", 3);
    put_byte(b, (uint8_t)type);
    put_be(b, a->m.agent_id, 4);
    put_be(b, sequence, 4);
    put_be(b, behind, 2);
    put_be(b, k->epoch, 4);
    put(b, k->boot, BOOT);
    put_be(b, revocations(k), 2);
}

static void seal(Agent *a, Buf *out, const uint8_t *plain, size_t n, const Opened *heard) {
    Keys *k = a->keys;
    int type = plain[3], asking = requested_by(type);
    uint32_t sequence = (uint32_t)read_be(plain + 8, 4);
    const uint8_t *body = plain + HEADER;
    size_t size = n - HEADER;
    Buf sealed = {0}, claim = {0};
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
    uint8_t nonce[NONCE], signature[SIGNATURE];
    Sender keys = sender_keys(k, k->epoch, a->m.agent_id, k->boot);
    nonce_of(&keys, sequence, nonce);
    put_be(out, CLEAR + sealed.len + SEAL, 2);
    size_t at = out->len;
    put_clear(out, a, type, sequence, sealed.len + SEAL);
    buf_room(out, sealed.len + TAG);
    encrypt(keys.key, nonce, sealed.data, sealed.len, out->data + at, CLEAR, out->data + at + CLEAR);
    out->len += sealed.len + TAG;
    put_tag(&claim, "UCP datagram", k);
    put(&claim, out->data + at, out->len - at);
    sign(k->private_key, &claim, signature);
    mask(&keys, sequence, signature);
    put(out, signature, SIGNATURE);
    free(sealed.data);
    free(claim.data);
}

static void keys_seal(Agent *a, const Opened *heard) {
    Keys *k = a->keys;
    Buf out = {0};
    look_at(k, a->now);
    if (k->tells) {
        k->tells = false;
        put_be(&out, CLEAR + k->revocation.len, 2);
        put_clear(&out, a, REVOCATION, 0, k->revocation.len);
        put(&out, k->revocation.data, k->revocation.len);
    }
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
    if (k->revocation.len > 0) {
        put_byte(b, REVOKED);
        put_be(b, k->revocation.len, 2);
        put(b, k->revocation.data, k->revocation.len);
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
        if (revocation_good(k, at + 2, size))           /* of keys that it had before: not */
            take_over(k, at + 2, size);
        return 2 + size;
    }
    return 0;
}

static void keys_boot(Agent *a) {                       /* this life is later than those before, whatever the clock says */
    Keys *k = a->keys;
    if (started_us(k) <= k->lived_us)
        write_be(k->boot, k->lived_us + 1, 8);
}
