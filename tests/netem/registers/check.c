/*
 * Whether every thread keeps its floating point and vector registers, whatever other threads, children and signal
 * handlers do to theirs: `check SECONDS`. Prints what was lost, and ends with status 1 if anything was.
 *
 * Each thread fills its registers with a pattern of its own, spins, and looks at them. Meanwhile it is preempted for
 * the others, interrupted by a handler that fills the registers anew and copies memory with the C library, and the
 * first of them forks.
 */

#define _GNU_SOURCE
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define THREADS 4
#define SPIN 200000

static volatile int over;
static volatile unsigned interruptions;
static int lost_x87, lost_vector, lost_mask, lost_copy, lost_child;

#define EACH_OF_16(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7) DO(8) DO(9) DO(10) DO(11) DO(12) DO(13) DO(14) DO(15)
#define THE_OTHER_16(DO) DO(16) DO(17) DO(18) DO(19) DO(20) DO(21) DO(22) DO(23) DO(24) DO(25) DO(26) DO(27) DO(28) \
	DO(29) DO(30) DO(31)
#define LOAD_XMM(N) "movdqu (%[pattern]), %%xmm" #N "\n"
#define LOAD_YMM(N) "vmovdqu (%[pattern]), %%ymm" #N "\n"
#define LOAD_ZMM(N) "vmovdqu64 (%[pattern]), %%zmm" #N "\n"
#define STORE_XMM(N) "movdqu %%xmm" #N ", " #N "*64(%[seen])\n"
#define STORE_YMM(N) "vmovdqu %%ymm" #N ", " #N "*64(%[seen])\n"
#define STORE_ZMM(N) "vmovdqu64 %%zmm" #N ", " #N "*64(%[seen])\n"
#define AND_SPIN "1: dec %[spin]\n jnz 1b\n"
#define CLOBBERED "memory", "cc", "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9", \
	"xmm10", "xmm11", "xmm12", "xmm13", "xmm14", "xmm15"

/* Fill, spin, store: `width` bytes of each of `count` registers. */
static void hold(const uint8_t *pattern, long spin, uint8_t (*seen)[64], uint64_t *mask, int *width, int *count)
{
	if (__builtin_cpu_supports("avx512bw")) {
		*width = 64, *count = 32;
		__asm__ volatile(EACH_OF_16(LOAD_ZMM) THE_OTHER_16(LOAD_ZMM) "kmovq (%[pattern]), %%k1\n" AND_SPIN
				 EACH_OF_16(STORE_ZMM) THE_OTHER_16(STORE_ZMM) "kmovq %%k1, (%[mask])\n vzeroupper\n"
				 : [spin] "+r"(spin) : [pattern] "r"(pattern), [seen] "r"(seen), [mask] "r"(mask) : CLOBBERED);
	} else if (__builtin_cpu_supports("avx")) {
		*width = 32, *count = 16;
		__asm__ volatile(EACH_OF_16(LOAD_YMM) AND_SPIN EACH_OF_16(STORE_YMM) "vzeroupper\n"
				 : [spin] "+r"(spin) : [pattern] "r"(pattern), [seen] "r"(seen) : CLOBBERED);
	} else {
		*width = 16, *count = 16;
		__asm__ volatile(EACH_OF_16(LOAD_XMM) AND_SPIN EACH_OF_16(STORE_XMM)
				 : [spin] "+r"(spin) : [pattern] "r"(pattern), [seen] "r"(seen) : CLOBBERED);
	}
}

/* How many of its registers a thread lost while it held them. */
static int look(uint8_t own)
{
	uint8_t pattern[64], seen[32][64];
	uint64_t expected, mask;
	double before = own * 1.25, after;
	int width, count, lost = 0;

	memset(pattern, own, sizeof pattern);
	memcpy(&expected, pattern, sizeof expected);
	mask = expected;
	__asm__ volatile("fldl %0" : : "m"(before));
	hold(pattern, SPIN, seen, &mask, &width, &count);
	__asm__ volatile("fstpl %0" : "=m"(after));
	if (before != after)
		__atomic_add_fetch(&lost_x87, ++lost, __ATOMIC_SEQ_CST);
	for (int number = 0; number < count; number++)
		if (memcmp(seen[number], pattern, width))
			__atomic_add_fetch(&lost_vector, 1, __ATOMIC_SEQ_CST), lost++;
	if (mask != expected)
		__atomic_add_fetch(&lost_mask, 1, __ATOMIC_SEQ_CST), lost++;
	return lost;
}

static void interrupt(int number)
{
	static char from[4096], to[4096];
	uint8_t pattern[64], seen[32][64];
	uint64_t mask;
	int width, count;

	(void)number;
	memset(pattern, 0xEE, sizeof pattern);
	hold(pattern, 1, seen, &mask, &width, &count);
	memset(from, 0xEE, sizeof from);
	memcpy(to, from, sizeof from);
	interruptions++;
}

static void copy(uint8_t own)
{
	static __thread uint8_t from[1 << 14], to[1 << 14];

	memset(from, own, sizeof from);
	for (int round = 0; round < 40; round++) {
		memset(to, 0, sizeof to);
		memcpy(to, from, sizeof from);
		for (size_t at = 0; at < sizeof to; at++)
			if (to[at] != own) {
				__atomic_add_fetch(&lost_copy, 1, __ATOMIC_SEQ_CST);
				break;
			}
	}
}

static void *work(void *number)
{
	uint8_t own = 1 + (uintptr_t)number;

	while (!over) {
		look(own);
		copy(own);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	struct sigaction action = {.sa_handler = interrupt, .sa_flags = SA_RESTART};
	struct itimerval often = {{0, 2000}, {0, 2000}};
	time_t end = time(NULL) + (argc > 1 ? atoi(argv[1]) : 3);
	pthread_t threads[THREADS];
	unsigned looks = 0, children = 0;
	int status;

	sigaction(SIGALRM, &action, NULL);
	setitimer(ITIMER_REAL, &often, NULL);
	for (uintptr_t number = 0; number < THREADS; number++)
		pthread_create(&threads[number], NULL, work, (void *)number);
	for (; time(NULL) < end; looks++) {
		look(0xAA);
		copy(0xAA);
		if (looks % 4)
			continue;
		children++;
		if (fork() == 0)
			_exit(look(0xBB) != 0);
		wait(&status);
		lost_child += status != 0;
	}
	over = 1;
	for (int number = 0; number < THREADS; number++)
		pthread_join(threads[number], NULL);
	printf("%u looks, %u interruptions, %u children; lost: %d x87, %d vector, %d mask, %d copies, %d in children\n", looks,
	       interruptions, children, lost_x87, lost_vector, lost_mask, lost_copy, lost_child);
	return lost_x87 || lost_vector || lost_mask || lost_copy || lost_child;
}
