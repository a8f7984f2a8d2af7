/*
 * ptrace(2) for a User Mode Linux older than 6.13, preloaded into it: see uml_registers.py.
 *
 * Linux takes the registers of a process back only as a whole (PTRACE_SETREGSET). What User Mode Linux knows of them is
 * laid over what the process has now.
 *
 * Into the frame of a signal it puts no more than FRAME bytes of them. Each state that it is given therefore has a
 * number in bytes that are software's to use. The number goes into the frame as well and comes back with it, and the
 * rest of the state is that of the number: of the process as it was interrupted, not as the handler left it.
 *
 * It includes nothing, so that a compiler will do without the headers of a C library. User Mode Linux calls it from one
 * thread, and never while it is in it.
 */

struct iovec {
	void *base;
	unsigned long length;
};

typedef long ptrace_function(int request, int pid, void *address, void *data);

extern void *dlsym(void *handle, const char *name);

#define RTLD_NEXT ((void *)-1L)
#define PTRACE_GETREGSET 0x4204
#define PTRACE_SETREGSET 0x4205
#define NT_X86_XSTATE ((void *)0x202L)

/* The layout that XSAVE has, in bytes. */
#define SPARE 496      /* for a number: eight of those that software may use */
#define IN_USE 512     /* a bit for each part that is not as it was in the beginning */
#define AVX_512 0xe0UL /* of these: what AVX-512 adds */
#define FRAME 832      /* all up to AVX, on any processor: only where the rest lies differs between makers */
#define ROOM 2696      /* what User Mode Linux has room for */

#define NUMBERS 16384  /* that are remembered: a handler may take a second */

static unsigned char state[1 << 20];
static struct {
	unsigned long number;
	unsigned char rest[ROOM - FRAME];
} remembered[NUMBERS];

static void remember(unsigned char *known, unsigned long length)
{
	static unsigned long last;
	unsigned long number = 0;

	if (*(unsigned long *)(known + IN_USE) & AVX_512) {
		number = ++last;
		remembered[number % NUMBERS].number = number;
		__builtin_memcpy(remembered[number % NUMBERS].rest, known + FRAME, length - FRAME);
	}
	*(unsigned long *)(known + SPARE) = number;
}

static void recall(unsigned char *known, unsigned long length)
{
	unsigned long number = *(unsigned long *)(known + SPARE);

	if (number && remembered[number % NUMBERS].number == number)
		__builtin_memcpy(known + FRAME, remembered[number % NUMBERS].rest, length - FRAME);
}

long ptrace(int request, int pid, void *address, void *data)
{
	static ptrace_function *next;
	struct iovec whole = {state, sizeof state};
	struct iovec *known = data;
	int all_known;

	if (!next)
		next = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
	if ((request != PTRACE_GETREGSET && request != PTRACE_SETREGSET) || address != NT_X86_XSTATE)
		return next(request, pid, address, data);

	if (next(PTRACE_GETREGSET, pid, NT_X86_XSTATE, &whole) < 0)
		return -1;
	if (known->length > whole.length)
		known->length = whole.length;
	all_known = known->length > FRAME && known->length <= ROOM;
	if (request == PTRACE_GETREGSET) {
		__builtin_memcpy(known->base, state, known->length);
		if (all_known)
			remember(known->base, known->length);
		return 0;
	}
	__builtin_memcpy(state, known->base, known->length);
	if (all_known)
		recall(state, known->length);
	return next(PTRACE_SETREGSET, pid, NT_X86_XSTATE, &whole);
}
